"""Surface extraction from Gaussians, cleaning and simplification."""
