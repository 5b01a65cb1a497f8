"""Campaigns: many trials that can be interrupted and resumed, in an order that limits walking."""
