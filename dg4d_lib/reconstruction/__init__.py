"""Feed-forward reconstruction of Gaussians from images."""
