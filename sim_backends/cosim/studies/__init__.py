"""Studies over many runs: how wrong a sync policy is, and what it costs."""
