"""Optimization of static Gaussians and of their deformation."""
