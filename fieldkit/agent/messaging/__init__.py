"""Publish and subscribe to ROS topics over each middleware, and streams of samples with their logs."""
