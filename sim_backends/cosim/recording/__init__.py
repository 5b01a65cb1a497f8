"""Recordings of runs: written during a run, readable even if the run is killed, and replayed to the same numbers."""
