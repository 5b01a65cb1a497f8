"""Field trials of robots whose radio links are under test."""

__version__ = "0.1.0"
