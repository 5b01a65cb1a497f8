"""Campaigns: many trials in an order that limits walking, which can be interrupted and resumed."""
