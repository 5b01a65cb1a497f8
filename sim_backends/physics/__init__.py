"""Physics federates: how agents move."""
