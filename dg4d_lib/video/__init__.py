"""Subjects, driving videos and what generates them."""
