"""Text for people: escaping, numbers, drawings."""
