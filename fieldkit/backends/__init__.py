"""Where robots come from: the protocols of backends, their registry, and the field backend."""
