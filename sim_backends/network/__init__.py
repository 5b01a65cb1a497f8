"""Network federates: they decide which packets arrive, and when."""
