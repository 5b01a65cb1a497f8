"""Studies over many runs: the errors and the costs of sync policies."""
