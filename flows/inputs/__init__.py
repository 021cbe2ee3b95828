"""User inputs: files, manifests and settings as conversion requests."""
