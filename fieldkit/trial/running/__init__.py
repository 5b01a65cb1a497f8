"""Run a trial on robots: open and lock them, run the preflight checks and all attempts, resume an interrupted trial."""
