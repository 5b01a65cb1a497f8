"""External federates (simulators in other processes), their wire protocol, and conformance checks."""
