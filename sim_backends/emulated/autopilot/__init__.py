"""Autopilot of an emulated drone, which flies a quadrotor model over MAVLink like PX4 or ArduCopter."""
