"""Preview films, contact sheets and the viewer page."""
