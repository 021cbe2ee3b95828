"""Textured meshes out of Gaussians."""
