"""Gazebo as physics: its adapter, which is compiled on first use, and SDF worlds from scenarios."""
