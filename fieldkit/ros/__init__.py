"""Robots with ROS: message types, middlewares, streams, bags, steps, bridge. Entry points add it to the harness."""
