"""From raw evidence to numbers: pure functions of files that a repeat left behind."""
