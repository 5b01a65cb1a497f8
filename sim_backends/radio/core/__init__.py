"""Shared by all parts of the radio model: links with their delays and losses, and random streams."""
