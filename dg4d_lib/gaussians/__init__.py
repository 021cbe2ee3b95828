"""Clouds of 3D Gaussians: the value, how it starts, how it grows, how it is stored."""
