"""File formats that steps exchange."""
