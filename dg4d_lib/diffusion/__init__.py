"""Pretrained diffusion models: components, schedules, samplers and micro-batching."""
