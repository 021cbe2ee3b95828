"""The numerical library of dg4d: tensors in, tensors out; it knows nothing of Prefect, steps or machines."""
