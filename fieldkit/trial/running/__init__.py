"""Carry a trial out on robots: open them, hold them, check them, make every attempt, go on where one stopped."""
