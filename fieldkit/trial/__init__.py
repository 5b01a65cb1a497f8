"""One trial: planning, checks, execution, journal, storage, and rebuilding its tables from the evidence."""
