"""Judges of pictures nobody took: score distillation and its priors."""
