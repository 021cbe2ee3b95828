"""One topology over time: skinning, registration and rigging."""
