"""Servers, workers, deployments: what stays when a command has ended."""
