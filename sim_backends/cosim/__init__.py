"""Co-simulation: robots that move and a network that carries their packets, at one simulated time."""
