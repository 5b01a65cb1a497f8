"""Checks before a trial: of each robot, whose state a shell script reads once, and of the plan."""
