"""Losses, delays and times of a transfer, computed from the packets of two captures."""
