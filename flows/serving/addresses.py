"""Paths of the background server beside those of Prefect."""

ARTIFACT_ADDRESS = "/dg4d/artifacts/"  # files of the store
VIEWER_ADDRESS = "/dg4d/viewer/"  # viewer pages of packages and of static splats
STUDIO_ADDRESS = "/dg4d/studio"  # page on which pictures are dropped
