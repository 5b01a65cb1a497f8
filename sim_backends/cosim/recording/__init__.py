"""Recordings of runs: written while a run goes on, readable whenever it ended, and replayed to the same numbers."""
