"""Textured meshes from Gaussians: extraction, tracking, texturing and rendering."""
