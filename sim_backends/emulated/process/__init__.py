"""Processes of an emulated lab, seen from outside: how they are started, told what to do, and ended."""
