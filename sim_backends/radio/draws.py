"""Random numbers one after the other."""

from sim_backends.radio.streams import Stream


class Counter:
    """Draws of a stream one after the other.

    Args:
        seed: As of `Stream`.
        name: As of `Stream`.
    """

    def __init__(self, seed: int, *name: str) -> None:
        self._stream = Stream(seed, *name)
        self._next = 0

    def draw(self) -> float:
        """Return the next number on [0, 1)."""
        self._next += 1
        return self._stream.draw(self._next - 1)
