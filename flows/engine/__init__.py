"""How a step becomes a cached, retried task, and where and when it runs."""
