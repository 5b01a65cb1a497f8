"""Sweeps: a scenario with all combinations of settings and seeds."""
