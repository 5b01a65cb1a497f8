"""Checks of `fieldkit check`: a shell script asks each robot once, pure functions judge what it said."""
