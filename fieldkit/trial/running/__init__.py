"""Run a trial on robots: open and lock them, run the preflight checks and every attempt, resume an interrupted trial."""
