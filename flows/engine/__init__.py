"""Execution of steps as cached, retried Prefect tasks: requests, executors, slots, leases, versions."""
