"""UV unwrapping and texture baking."""
