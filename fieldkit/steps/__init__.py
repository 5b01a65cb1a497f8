"""Kinds of step: one module each, which owns its YAML, commands, needs, files, gates and columns."""
