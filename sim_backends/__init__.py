"""Simulated and emulated robots, radio and worlds: back ends that `fieldkit` loads through entry points."""
