"""Texture refinement."""
