"""True positions of robots: their sources, trajectories over time, and the columns computed from them."""
