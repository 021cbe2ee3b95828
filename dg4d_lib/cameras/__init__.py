"""Cameras on an orbit and sets of viewpoints."""
