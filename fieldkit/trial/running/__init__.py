"""Run a trial on robots: open and lock them, run preflight and every attempt, resume an interrupted trial."""
