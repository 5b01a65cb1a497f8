"""The radio between robots: pure models on integer nanoseconds, for a virtual clock or the monotonic one."""
