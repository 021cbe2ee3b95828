"""Ground truth of our own making: painted things that move and can be seen from anywhere at any time."""
