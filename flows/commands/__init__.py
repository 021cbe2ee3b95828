"""Commands of `dg4d` and their terminal output."""
