"""The two optimizations: static Gaussians and their motion."""
