"""Programs that train the networks that the product ships."""
