"""Numerical library of dg4d: tensors in, tensors out; independent of Prefect and of the steps."""
