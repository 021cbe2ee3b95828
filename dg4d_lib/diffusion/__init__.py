"""What users of pretrained diffusion models share: loading their parts, and fitting batches into memory."""
