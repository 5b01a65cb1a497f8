"""A day in the field: many trials, in an order that a person can walk, stopped and gone on with at will."""
