"""Garment decoders, sewing patterns and their latent spaces."""
