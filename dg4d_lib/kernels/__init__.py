"""What compiled kernels share: vector instructions, threads and memory."""
