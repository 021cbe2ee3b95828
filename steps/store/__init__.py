"""Content-addressed store: a folder, or a bucket of an S3-compatible object store."""
