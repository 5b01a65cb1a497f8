"""Radio models between robots: pure, on integer nanoseconds, for a virtual clock or the monotonic clock."""
