"""Communicate with an autopilot over MAVLink: frames, dialects, its state, recordings."""
