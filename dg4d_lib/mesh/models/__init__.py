"""Models of users: parts with materials, subdivision, deformation graph, and one texture for all parts."""
