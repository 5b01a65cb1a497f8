"""Trials in Python: `fieldkit.load` and what it returns. Other names of this package may change; these stay."""
