"""Execution of steps: job interface, process set-up, fork server, environment and weights."""
