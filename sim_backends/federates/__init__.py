"""Federates outside the coordinator's process: their protocols, the wire protocol, both of its sides, conformance."""
