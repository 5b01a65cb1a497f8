"""Statistics over repeats: estimates, intervals, comparisons, expectations, and their tables."""
