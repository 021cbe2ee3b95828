"""Closed, colored surface inflated from one cut-out picture, without weights."""
