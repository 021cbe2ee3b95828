"""Readers of user files: pictures, videos, frame archives and view banks."""
