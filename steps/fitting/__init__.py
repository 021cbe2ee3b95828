"""Priors, reconstruction and reports that both fits share."""
