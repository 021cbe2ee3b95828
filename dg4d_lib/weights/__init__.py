"""Pretrained weights: registry, location, verification and download. Imports no torch."""
