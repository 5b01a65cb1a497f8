"""Texts of an autopilot for people."""

from __future__ import annotations

import struct

NOTICE, WARNING = 5, 4
"""MAV_SEVERITY; what is more severe has a lower number."""

_MOST_TEXTS, _MOST_CHARACTERS = 30, 500
_CHUNK = struct.Struct("<HB")


class AutopilotTexts:
    """Texts of STATUSTEXT, notices and what is more severe."""

    def __init__(self) -> None:
        self._texts: list[tuple[int, str]] = []
        self._number = self._count = self._taken = 0

    def take(self, payload: bytes) -> None:
        """Take a message; a long text comes in pieces with one number (STATUSTEXT, id and chunk_seq)."""
        text = printable(payload[1:51].split(b"\0")[0].decode("utf-8", "replace"))
        number, piece = _CHUNK.unpack_from(payload, 51)
        severity = payload[0]
        if severity > NOTICE:
            return
        if piece and number == self._number and self._texts:
            severity, before = self._texts[-1]
            self._texts[-1] = severity, (before + text)[:_MOST_CHARACTERS]
        elif not piece:
            self._texts = [*self._texts[1 - _MOST_TEXTS :], (severity, text)]
            self._count += 1
        self._number = number

    def new(self) -> list[str]:
        """Return the texts that have come since the last call."""
        count, self._taken = min(self._count - self._taken, len(self._texts)), self._count
        return [text for _, text in self._texts[len(self._texts) - count :]]

    @property
    def warnings(self) -> list[str]:
        """Warnings and what is more severe, the last at the end."""
        return [text for severity, text in self._texts if severity <= WARNING]

    @property
    def last(self) -> str:
        """The last text; empty where there is none."""
        return self._texts[-1][1] if self._texts else ""

    def forget(self) -> None:
        """Forget all texts."""
        self._texts = []
        self._taken = self._count


def printable(text: str) -> str:
    """Return a text of an autopilot with a `?` for each character that is not printable."""
    return "".join(character if character.isprintable() else "?" for character in text)
