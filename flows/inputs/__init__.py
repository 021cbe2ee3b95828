"""What is asked for: files, manifests and settings become jobs."""
