"""Access to robots over SSH: commands, detached jobs, files."""
