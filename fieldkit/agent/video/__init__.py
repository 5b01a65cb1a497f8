"""Frames of a synthetic camera."""
