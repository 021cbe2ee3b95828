"""Ten assets for the gallery: their pictures, the conversions and the page."""
