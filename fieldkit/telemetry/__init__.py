"""Telemetry sources of a robot's profile: the state of radios without `iw`, from commands that print it."""
