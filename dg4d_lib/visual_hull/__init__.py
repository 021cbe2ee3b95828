"""Shape and colors of a subject from pictures of several sides."""
