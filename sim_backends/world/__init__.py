"""The world of the robots: obstacles with materials, shared by radio and physics."""
