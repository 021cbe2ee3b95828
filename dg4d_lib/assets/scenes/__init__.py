"""Scenes composed of several animated assets."""
