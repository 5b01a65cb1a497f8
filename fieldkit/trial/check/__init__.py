"""Checks of the robots and of the plan before a trial. One shell script reads the state of a robot."""
