"""What each command of `dg4d` does, and how it looks on a terminal."""
