"""Network federates: they determine which packets arrive, and when."""
