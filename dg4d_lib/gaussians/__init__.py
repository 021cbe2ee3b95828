"""Clouds of 3D Gaussians: representation, initialization, density control, transforms and PLY files."""
