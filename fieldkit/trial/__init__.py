"""One trial: planned, checked, run, journalled, kept on disk, and made again from its evidence."""
