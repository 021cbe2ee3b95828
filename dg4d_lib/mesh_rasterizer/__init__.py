"""Which triangle a camera sees in every pixel, and where in it."""
