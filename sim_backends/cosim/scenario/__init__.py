"""Scenarios: files that describe a co-simulation, and the objects that are built from them."""
