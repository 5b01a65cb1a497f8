"""Sync policies: they determine how long physics and network run without an exchange of data (a window)."""
