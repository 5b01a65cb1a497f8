"""State of a robot's clock, computer and radio before and after an attempt, as reported by the robot's programs."""
