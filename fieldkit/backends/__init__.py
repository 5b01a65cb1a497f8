"""Sources of robots: the protocols of backends, their registry, and the field backend."""
