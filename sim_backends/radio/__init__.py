"""Radio models. They use no clock and no socket: the caller passes the time, virtual or monotonic, in nanoseconds."""
