"""Quaternions, spherical harmonics, normals and mirror planes."""
