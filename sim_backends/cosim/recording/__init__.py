"""Recordings of runs: written during a run, readable after any end of it, and replayed to the same numbers."""
