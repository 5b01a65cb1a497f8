"""Synchronization policies: how long physics and network run independently, and which states the network assumes."""
