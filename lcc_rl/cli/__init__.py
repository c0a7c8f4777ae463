"""Command lines with messages and exit codes."""
