"""Robots that drive automatically, or fly over MAVLink. Entry points add this package to the harness."""
