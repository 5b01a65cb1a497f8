"""The medium: the process that carries packets between robots, and the lab's client of it."""
