"""Rotations, color harmonics and grids."""
