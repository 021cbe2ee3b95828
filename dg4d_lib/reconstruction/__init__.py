"""From pictures to Gaussians in one pass of a network, without optimization."""
