"""Caches of computed properties of links, each with the revision and the time slot for which it is valid."""

import numpy as np
from numpy.typing import NDArray

from sim_backends.radio.propagation.fading import Echoes, Fades
from sim_backends.world.shapes import Floats


class LinkRow:
    """The links of one station to all others, by index, valid for one revision of the channel.

    Args:
        revision: Revision of positions, velocities, cuts and losses for which it was computed.
        mean_mw: Received power of the station at each other station, without fading, in mW.

    Attributes:
        is_linked: For each station, True if the two stations receive each other without fading; None before the
            first use.
        slot: Number of the time slot for which `powers_mw` was computed; gains are constant in a slot. -1 for none.
        powers_mw: Received power of the station at each other station in that slot; without fading if `slot` is -1.
    """

    __slots__ = ("is_linked", "mean_mw", "powers_mw", "revision", "slot")

    def __init__(self, revision: int, mean_mw: Floats) -> None:
        self.revision = revision
        self.mean_mw = mean_mw
        self.is_linked: list[bool] | None = None
        self.slot = -1
        self.powers_mw: list[float] = mean_mw.tolist()


class GainCache:
    """The gains of some links, valid for one revision of the channel and one time slot.

    Args:
        links: Indices of the links.
        ends: Indices of the stations at their first ends, and at their second ends, shape (2, n).
        echoes: Their echoes.

    Attributes:
        revision: Revision for which `fades` was computed; -1 before the first use.
        fades: Gains over time in this revision; None before the first use.
        slot: Time slot for which `gains` was computed; -1 if there are none.
        gains: Gains in that slot, in the order of `links`.
    """

    __slots__ = ("echoes", "ends", "fades", "gains", "links", "revision", "slot")

    def __init__(self, links: NDArray[np.int64], ends: NDArray[np.int64], echoes: Echoes) -> None:
        self.links = links
        self.ends = ends
        self.echoes = echoes
        self.revision = self.slot = -1
        self.fades: Fades | None = None
        self.gains = np.empty(0)
