"""Prefect flows: order, resources and retries of the steps; imports no torch."""
