"""Counter-based random streams: equal names give equal draws, whatever is drawn before, after or in between.

Draws that decide over packets are keyed by what a packet is, never by how many draws came before: so one packet or
one attempt more shifts no other's fate, and two runs that differ a little can be compared packet by packet.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.random import Philox  # which numpy itself would import at the first draw, while a packet waits
from numpy.typing import NDArray

# Most streams are asked for a few draws only: one per flow, attempt and purpose.
_BLOCK: Final = 64
# Philox-4x64 turns one step of its counter into four 64-bit words.
_STEPS_PER_BLOCK: Final = _BLOCK // 4


PacketIdentity = tuple[str, int]
"""A flow, and which of its packets it is: what all random draws for a packet are keyed by."""


class RandomStream:
    """Uniform draws on [0, 1), one per packet number, for one purpose.

    The draw for number n is the n-th word of Philox-4x64 (Salmon et al., "Parallel random numbers: as easy as 1, 2,
    3", SC 2011) under a key hashed from the name. Words come in blocks and the last block is kept, so numbers
    in rising order cost a list look-up each.

    Args:
        seed: The trial's seed.
        name: Words that name the stream, for example transmitter, receiver and purpose.
    """

    def __init__(self, seed: int, *name: str) -> None:
        self._key = int.from_bytes(_key(seed, name), "little")
        self._number_of_block = -1
        self._block: list[float] = []

    def draw(self, number: int) -> float:
        """Return the draw for packet `number`, counted from 0."""
        block, offset = divmod(number, _BLOCK)
        if block != self._number_of_block:
            self._block = self._generate(block)
            self._number_of_block = block
        return self._block[offset]

    def first(self, count: int) -> NDArray[np.float64]:
        """Return the draws for the numbers below `count`."""
        return self._uniforms(0, count)

    def _generate(self, block: int) -> list[float]:
        uniforms: list[float] = self._uniforms(block * _STEPS_PER_BLOCK, _BLOCK).tolist()
        return uniforms

    def _uniforms(self, counter: int, count: int) -> NDArray[np.float64]:
        # Raw words, because numpy promises their values across versions and those of its distributions not.
        return _uniforms(Philox(key=self._key, counter=counter).random_raw(count))


def first_draws(seed: int, names: Sequence[Sequence[str]], count: int) -> NDArray[np.float64]:
    """Return the first draws of `RandomStream(seed, *name)` by name, in a third of the time. Shape (names, count)."""
    generator = Philox(key=0)
    unused = generator.state
    words = np.empty((len(names), count), dtype=np.uint64)
    for row, name in zip(words, names, strict=True):
        unused["state"]["key"] = np.frombuffer(_key(seed, name), dtype="<u8")
        generator.state = unused
        row[:] = generator.random_raw(count)
    return _uniforms(words)


def _key(seed: int, name: Sequence[str]) -> bytes:
    return hashlib.blake2b(json.dumps([seed, *name]).encode(), digest_size=16).digest()


def _uniforms(words: NDArray[np.uint64]) -> NDArray[np.float64]:
    uniforms: NDArray[np.float64] = (words >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return uniforms


class PacketDraws:
    """Draws for packets, for one purpose at one station or on one link.

    Args:
        seed: As of `RandomStream`.
        name: As of `RandomStream`.
    """

    def __init__(self, seed: int, *name: str) -> None:
        self._seed = seed
        self._name = name
        # By flow and occasion, so that the numbers of a stream follow each other.
        self._streams: dict[tuple[str, int], RandomStream] = {}

    def draw(self, packet: PacketIdentity, occasion: int = 0) -> float:
        """Return the draw on [0, 1) for a packet on one of several occasions, for example an attempt at it."""
        flow, number = packet
        stream = self._streams.get((flow, occasion))
        if stream is None:
            stream = self._streams[flow, occasion] = RandomStream(self._seed, *self._name, flow, str(occasion))
        return stream.draw(number)
