"""Sync policies: the time for which physics and network run independently, and the assumed states."""
