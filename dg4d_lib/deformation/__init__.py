"""How Gaussians move over time."""
