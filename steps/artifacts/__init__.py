"""Content-addressed store and the file formats that steps exchange."""
