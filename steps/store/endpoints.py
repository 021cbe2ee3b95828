"""Environment variables that name the endpoint of an S3-compatible object store, and loopback hosts."""

ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
LOOPBACK = {"localhost", "127.0.0.1", "::1"}
