"""From many repeats to what they say together."""
