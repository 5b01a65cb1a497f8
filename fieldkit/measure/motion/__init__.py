"""Evidence of robots that move by themselves: logs of drives and flights, telemetry, and their checks."""
