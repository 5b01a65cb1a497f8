"""Kinds of step of robots that move by themselves, and what these kinds share."""
