"""Texture refinement with diffusion models."""
