"""Deformation models: displacements of Gaussians over time."""
