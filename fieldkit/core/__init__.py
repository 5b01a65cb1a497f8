"""Basics that every room shares: data types, units, errors, deadlines, events, files."""
