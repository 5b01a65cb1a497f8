"""Processes of an emulated lab, seen from outside: their start, the requests to them, their end."""
