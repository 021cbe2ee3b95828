"""Learned prior on shapes: from one cut-out picture to the matter behind every pixel."""
