"""Emulated robots: namespaces with real tools, and the process that carries their packets."""
