"""Publish-subscribe as in DDS: RTPS, best effort or reliable, with discovery."""
