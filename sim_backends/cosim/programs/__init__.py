"""Programs that agents of a scenario run."""
