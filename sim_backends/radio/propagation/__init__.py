"""Propagation between radios: path loss, fading, antenna patterns."""
