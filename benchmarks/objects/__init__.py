"""Synthetic ground truth: painted animated objects that can be rendered from any view at any time."""
