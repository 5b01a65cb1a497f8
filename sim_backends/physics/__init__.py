"""Physics federates: they compute the motion of agents."""
