"""Sync policies: until when physics and network go on without each other, and what they then know."""
