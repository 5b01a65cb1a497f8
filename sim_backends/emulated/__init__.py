"""Emulated robots: namespaces with real tools, and a process that carries their packets."""
