"""Run a trial on robots: open and lock them, run preflight checks and attempts, resume an interrupted trial."""
