"""The autopilot of an emulated drone: a point mass with limits, flown over MAVLink as PX4 is."""
