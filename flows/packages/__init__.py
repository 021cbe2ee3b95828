"""What a run leaves: packages, their records, reports and versions."""
