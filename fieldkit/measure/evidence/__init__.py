"""Parsers of the files of every other tool, and of those that testbeds and robots write."""
