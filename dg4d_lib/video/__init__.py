"""Subject matting and framing, driving videos and their generators."""
