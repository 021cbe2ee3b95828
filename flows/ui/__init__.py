"""Pages and galleries in the Prefect UI."""
