"""Scenes of several animated assets."""
