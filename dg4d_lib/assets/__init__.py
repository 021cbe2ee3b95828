"""Files that leave the house: GLB, splats, previews."""
