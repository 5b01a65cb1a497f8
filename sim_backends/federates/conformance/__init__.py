"""Conformance suite: checks that an external federate follows the protocol."""
