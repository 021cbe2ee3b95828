"""Studio: the page on which pictures are dropped, converted and looked at, beside the Prefect server."""
