"""Guidance priors and score distillation."""
