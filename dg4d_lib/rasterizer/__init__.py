"""Differentiable rasterizers of 3D Gaussians: one interface, several backends."""
