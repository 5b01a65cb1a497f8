"""The world that robots stand in: obstacles with materials, shared by radio and physics."""
