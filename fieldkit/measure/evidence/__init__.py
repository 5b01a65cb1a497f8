"""Parsers of the output files of external tools, testbeds and robots."""
