"""Basics that all packages share: data types, units, errors, deadlines, events, files."""
