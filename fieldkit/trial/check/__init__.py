"""Checks of `fieldkit check`: a shell script reads the state of each robot once, and pure functions judge it."""
