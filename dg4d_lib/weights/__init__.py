"""Trained weights: which are known, where they lie, whether they are whole; imports no torch."""
