"""Evidence of self-moving robots: logs of drives and flights, telemetry, and their checks."""
