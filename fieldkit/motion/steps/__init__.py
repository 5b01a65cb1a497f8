"""Kinds of step of robots that move automatically, and code that these kinds share."""
