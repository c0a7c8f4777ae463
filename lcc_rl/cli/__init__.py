"""The commands: what is typed, and the exit codes and messages of what goes wrong."""
