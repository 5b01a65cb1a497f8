"""Robots at the other end of a connection: commands, detached jobs, files."""
