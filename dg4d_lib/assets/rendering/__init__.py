"""Preview videos, contact sheets and the viewer page."""
