"""Priors and starting clouds that both fits share."""
