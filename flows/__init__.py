"""Prefect flows: what runs when, on what, with which retries; imports no torch."""
