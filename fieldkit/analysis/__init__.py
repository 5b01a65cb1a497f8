"""Statistics over repeats: estimates, intervals, comparisons, expectations, and tables of them."""
