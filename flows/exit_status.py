"""Exit codes of commands."""

EXIT_FAILED = 1
EXIT_BAD_INPUT = 65
EXIT_MISSING = 69
EXIT_HANGUP, EXIT_INTERRUPTED, EXIT_TERMINATED = 129, 130, 143  # 128 + signal number, as in shells
