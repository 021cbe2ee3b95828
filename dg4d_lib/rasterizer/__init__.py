"""Differentiable splatting: one call, several backends."""
