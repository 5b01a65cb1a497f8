"""Running a trial on robots: connections and locks, preflight checks, attempts, and resumption."""
