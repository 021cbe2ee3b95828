"""The pipeline's steps: files in, files out; each runs alone, in a process or a container of its own."""
