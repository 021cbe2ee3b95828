"""UV maps and textures baked from Gaussians."""
