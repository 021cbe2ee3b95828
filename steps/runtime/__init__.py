"""Job contract, entry point and environment of a running step."""
