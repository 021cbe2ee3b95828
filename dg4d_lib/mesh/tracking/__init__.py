"""Mesh tracking with fixed topology: skinning, registration and rigging."""
