"""Capture files as numpy columns of packets."""
