"""TCP between agents: one connection per flow, on any `Wire`."""
