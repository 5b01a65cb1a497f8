"""Positions of robots as they really were: who told them, paths over time, columns."""
