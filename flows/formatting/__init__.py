"""Text for people: escaped, shortened, drawn."""
