"""Shared parts of the Numba kernels: compilation cache, SIMD instructions, threads and memory."""
