"""Trials in Python: `fieldkit.load` and the objects it returns. Only these are stable; other names may change."""
