"""Processes of an emulated lab: start, requests, stop."""
