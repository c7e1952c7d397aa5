"""Garment Recon: from a photo or scan of a dressed person to simulation-ready garments. Tensors in, tensors out."""

__version__ = "0.1.0"
