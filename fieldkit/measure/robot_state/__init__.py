"""State of a robot before and after an attempt, as its programs report it: its clock, with columns and marks."""
