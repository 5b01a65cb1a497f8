"""Parts of a trial with robots that move automatically: permission, journal of motions, guards of drones."""
