"""Sync policies: they determine how long physics and network run independently, and the states that they assume."""
