"""Text messages of an autopilot (STATUSTEXT)."""

from __future__ import annotations

import struct

NOTICE, WARNING = 5, 4
"""MAV_SEVERITY; a lower number is more severe."""

_MAX_TEXTS, _MAX_CHARACTERS = 30, 500
_CHUNK = struct.Struct("<HB")


class AutopilotTexts:
    """The last `_MAX_TEXTS` texts of STATUSTEXT messages that are at least as severe as `NOTICE`."""

    def __init__(self) -> None:
        self._texts: list[tuple[int, str]] = []
        self._last_id = self._count = self._read_count = 0

    def add_message(self, payload: bytes) -> None:
        """Add a message, unless it is less severe than `NOTICE`.

        A long text arrives in chunks with the same id (STATUSTEXT, id and chunk_seq).
        """
        # The payload has the severity (1 byte), a text of 50 bytes, the id and chunk_seq.
        text = printable(payload[1:51].split(b"\0")[0].decode("utf-8", "replace"))
        message_id, chunk_index = _CHUNK.unpack_from(payload, 51)
        severity = payload[0]
        if severity > NOTICE:
            return
        if chunk_index and message_id == self._last_id and self._texts:
            severity, previous = self._texts[-1]
            self._texts[-1] = severity, (previous + text)[:_MAX_CHARACTERS]
        elif not chunk_index:
            self._texts = [*self._texts[1 - _MAX_TEXTS :], (severity, text)]
            self._count += 1
        self._last_id = message_id

    def unread(self) -> list[str]:
        """Return the stored texts that have arrived since the last call."""
        count, self._read_count = min(self._count - self._read_count, len(self._texts)), self._count
        return [text for _, text in self._texts[len(self._texts) - count :]]

    @property
    def warnings(self) -> list[str]:
        """The texts that are at least as severe as `WARNING`, in order of arrival."""
        return [text for severity, text in self._texts if severity <= WARNING]

    @property
    def last_text(self) -> str:
        """The last text; empty if there is none."""
        return self._texts[-1][1] if self._texts else ""

    def clear(self) -> None:
        """Delete all texts."""
        self._texts = []
        self._read_count = self._count


def printable(text: str) -> str:
    """Return a text in which each character that is not printable is replaced by `?`."""
    return "".join(character if character.isprintable() else "?" for character in text)
