"""Robots, radio and worlds that stand in for the field: back ends that `fieldkit` finds through entry points."""
