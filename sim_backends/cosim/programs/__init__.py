"""The programs that run on the agents of a scenario."""
