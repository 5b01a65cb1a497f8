"""Recordings of runs. They are written during a run, and are readable even if the run is killed."""
