"""Background server, workers, pools and deployments, which outlive a command."""
