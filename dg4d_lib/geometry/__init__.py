"""Quaternions and spherical-harmonics colors."""
