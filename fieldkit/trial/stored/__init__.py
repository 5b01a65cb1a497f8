"""Trials in their folders: tables of many trials, checks of their files, measuring again, positions added later."""
