"""Cloth physics: energies, contact, simulation, minimisation."""
