"""Sizes of files for people."""


def readable(size_bytes: int) -> str:
    """Return a number of bytes as kB or MB."""
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes >= 100_000 else f"{size_bytes / 1e3:.1f} kB"
