"""What surrounds a trial with robots that move by themselves: permission, journal of motions, guards of drones."""
