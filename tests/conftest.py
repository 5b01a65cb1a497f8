"""Fixtures that several folders share."""

from tests.sshd import server

__all__ = ["server"]
