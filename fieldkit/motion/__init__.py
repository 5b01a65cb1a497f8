"""Robots that move by themselves: they drive, or fly over MAVLink. Entry points add this package to the harness."""
