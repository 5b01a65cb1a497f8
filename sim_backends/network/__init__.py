"""Network federates: what becomes of packets."""
