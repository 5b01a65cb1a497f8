"""Scenarios: files that say what a co-simulation has in it, and what is built from them."""
