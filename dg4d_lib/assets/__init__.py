"""Deliverable files: GLB, USDZ, splats, previews and the viewer page."""
