"""Z-buffer rasterizer for triangle meshes, and mip-mapped texture sampling."""
