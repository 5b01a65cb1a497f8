"""Stored trials: tables of many trials, checks of files, measurements from the evidence, positions added later."""
