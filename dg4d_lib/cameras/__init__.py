"""Orbit cameras and sets of viewpoints."""
