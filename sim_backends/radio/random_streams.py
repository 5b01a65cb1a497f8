"""Counter-based random streams: equal names give equal draws, whatever is drawn before, after or in between."""

import hashlib
import json
from typing import Final

import numpy as np
from numpy.random import Philox  # which numpy itself would import at the first draw, while a packet waits

_BLOCK: Final = 1024
# Philox-4x64 turns one step of its counter into four 64-bit words.
_STEPS_PER_BLOCK: Final = _BLOCK // 4


class Stream:
    """Uniform draws on [0, 1), one per packet number, for one purpose.

    The draw for number n is the n-th word of Philox-4x64 (Salmon et al., "Parallel random numbers: as easy as 1, 2,
    3", SC 2011) under a key hashed from the name. Words come in blocks and the last block is kept, so numbers
    in rising order cost a list look-up each.

    Args:
        seed: The trial's seed.
        name: Words that name the stream, for example transmitter, receiver and purpose.
    """

    def __init__(self, seed: int, *name: str) -> None:
        digest = hashlib.blake2b(json.dumps([seed, *name]).encode(), digest_size=16).digest()
        self._key = int.from_bytes(digest, "little")
        self._number_of_block = -1
        self._block: list[float] = []

    def draw(self, number: int) -> float:
        """Return the draw for packet `number`, counted from 0."""
        block, offset = divmod(number, _BLOCK)
        if block != self._number_of_block:
            self._block = self._generate(block)
            self._number_of_block = block
        return self._block[offset]

    def _generate(self, block: int) -> list[float]:
        # Raw words, because numpy promises their values across versions and those of its distributions not.
        words = Philox(key=self._key, counter=block * _STEPS_PER_BLOCK).random_raw(_BLOCK)
        uniforms: list[float] = ((words >> np.uint64(11)) * 2.0**-53).tolist()
        return uniforms


class DrawSequence:
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
