"""Measurements: pure functions that compute numbers from the evidence files of a repeat."""
