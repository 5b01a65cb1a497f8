"""The channel between stations that stand or move in a world: path loss, obstacles, fading."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.config.profiles import Radio
from fieldkit.core.model import Vector
from sim_backends.radio import propagation
from sim_backends.radio.channel import RadioChannel
from sim_backends.radio.fading import Fading, Shadowing
from sim_backends.radio.frames import decibel
from sim_backends.radio.modes import MODES, Mode, Standard
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.packet_error import packet_error
from sim_backends.radio.random_streams import DrawSequence
from sim_backends.radio.rate_control import FixedRate, Minstrel, RateControl
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S
from sim_backends.world.shapes import Floats
from sim_backends.world.world import World

CHANNEL_6_HZ: Final = 2.437e9

# A gain is used for this share of the time in which the echoes turn once.
_KEPT_TURN: Final = 0.02
_SLOWEST_M_S: Final = 1e-6
_STILL: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Antenna:
    """A station as the air sees it.

    Attributes:
        standard: What its radio speaks.
        tx_power_dbm: Power that it sends with.
        sensitivity_dbm: Weakest frame that it detects.
    """

    standard: Standard
    tx_power_dbm: float
    sensitivity_dbm: float


def antenna_of(radio: Radio) -> Antenna:
    """Return the antenna of a robot's radio; what is not 802.11n speaks 802.11g."""
    standard: Standard = "802.11n" if radio.standard.startswith("802.11n") else "802.11g"
    return Antenna(standard, float(radio.tx_power_dbm), float(radio.sensitivity_dbm))


class WorldChannel(RadioChannel):
    """The channel between stations that stand, or move, in a world.

    Args:
        seed: Of shadowing and fading.
        antennas: The stations.
        options: What the air does.
        world: What stands between them; None for open ground.
    """

    def __init__(
        self, seed: int, antennas: Mapping[str, Antenna], options: RadioOptions, world: World | None = None
    ) -> None:
        # The tables of errors are made now, not while the first frames wait for them.
        for mode in (*MODES["802.11g"], *MODES["802.11n"]):
            packet_error(mode, 0.0, 1)
        self.names = tuple(antennas)
        self.noise_mw = [milliwatt(options.noise_floor_dbm)] * len(self.names)
        self.sensitivity_mw = [milliwatt(antenna.sensitivity_dbm) for antenna in antennas.values()]
        self._seed = seed
        self._antennas = tuple(antennas.values())
        self._options = options
        self._world = world
        self._shadowing = (
            Shadowing(seed, options.shadowing_db, options.decorrelation) if options.shadowing_db else None
        )
        wavelength_m = SPEED_OF_LIGHT_M_S / CHANNEL_6_HZ
        self._pairs = tuple(combinations(range(len(self.names)), 2))
        links = [sorted(self.names[index] for index in pair) for pair in self._pairs] if options.fading else []
        self._fading = Fading(seed, links, wavelength_m=wavelength_m)
        # Row by transmitter, without itself: the link to each other station.
        self._links_of = [
            np.array([n for n, pair in enumerate(self._pairs) if station in pair], dtype=np.int64)
            for station in range(len(self.names))
        ]
        self._states: list[tuple[Vector | None, Vector]] = [(None, _STILL)] * len(self.names)
        self._speeds_m_s = np.full(len(self._pairs), options.stir_m_s)
        self._kept_ns = 0
        self._delays_ns = [[0] * len(self.names) for _ in self.names]
        self.set_powers([[0.0] * len(self.names) for _ in self.names])

    def move(
        self, now_ns: int, places_m: Mapping[str, Vector], velocities_m_s: Mapping[str, Vector] | None = None
    ) -> None:
        """Take it that the stations are at `places_m` now and move with `velocities_m_s`, or stand.

        Who has no place is out of everybody's range. Only the links of who is elsewhere than before, or moves
        otherwise, are looked at again.
        """
        moving = velocities_m_s or {}
        states = [(places_m.get(name), moving.get(name, _STILL)) for name in self.names]
        moved = {index for index, before in enumerate(self._states) if states[index] != before}
        self._states = states
        if moved:
            self._link(now_ns, [n for n, pair in enumerate(self._pairs) if not moved.isdisjoint(pair)])

    def _link(self, now_ns: int, pairs: list[int]) -> None:
        """Take it that these links are as the places and velocities of their ends say, from now on."""
        places = np.array([place or _STILL for place, _ in self._states], dtype=np.float64)
        velocities = np.array([velocity for _, velocity in self._states], dtype=np.float64)
        ends = [self._pairs[n] for n in pairs]
        first, second = np.array(ends, dtype=np.int64).reshape(-1, 2).T
        start, end = places[first], places[second]
        obstacles_db = self._obstacles_db(start, end)
        loss_db = self._open_db(start, end) + obstacles_db
        delay_ns = np.rint(np.linalg.norm(end - start, axis=1) / SPEED_OF_LIGHT_M_S * 1e9).astype(int)
        # A row may be that of a frame on the air, which arrives as strong as it was sent.
        powers_mw = [list(row) for row in self._mean_mw]
        for (one, other), loss, delay in zip(ends, loss_db.tolist(), delay_ns.tolist(), strict=True):
            present = self._states[one][0] is not None and self._states[other][0] is not None
            for sender, receiver in ((one, other), (other, one)):
                sent_dbm = self._antennas[sender].tx_power_dbm
                powers_mw[sender][receiver] = milliwatt(sent_dbm - loss) if present else 0.0
                self._delays_ns[sender][receiver] = delay
        if self._options.fading and pairs:
            speed_m_s = np.linalg.norm(velocities[first] - velocities[second], axis=1) + self._options.stir_m_s
            # Whatever stands in the way takes something.
            self._fade(now_ns, pairs, speed_m_s, obstacles_db == 0)
        self.set_powers(powers_mw)

    def _fade(self, now_ns: int, pairs: list[int], speed_m_s: Floats, sight: NDArray[np.bool_]) -> None:
        k = 10 ** (self._options.k_db / 10)
        self._speeds_m_s[pairs] = speed_m_s
        links = np.array(pairs, dtype=np.int64)
        self._fading.use(now_ns, links, speed_m_s=speed_m_s, k=np.where(sight, k, 0.0))
        wavelength_m = SPEED_OF_LIGHT_M_S / CHANNEL_6_HZ
        fastest_m_s = max(float(self._speeds_m_s.max()), _SLOWEST_M_S)
        self._kept_ns = round(_KEPT_TURN * wavelength_m / fastest_m_s * 1e9)

    def set_powers(self, powers_mw: Sequence[Sequence[float]]) -> None:
        """Take it that each transmitter (row) arrives at each receiver (column) with this mean power, in mW."""
        self._mean_mw = [list(row) for row in powers_mw]
        # Without fading a power holds until somebody moves.
        self._now_mw = [(row, -1 if self._options.fading else math.inf) for row in self._mean_mw]

    def loss_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the mean loss of paths between points of shape (n, 3), shadowing and obstacles included, in dB."""
        return self._open_db(start_m, end_m) + self._obstacles_db(start_m, end_m)

    def _open_db(self, start_m: Floats, end_m: Floats) -> Floats:
        match self._options.propagation:
            case "free-space":
                loss_db = propagation.free_space_db(start_m, end_m, CHANNEL_6_HZ)
            case "two-ray":
                loss_db = propagation.two_ray_db(start_m, end_m, CHANNEL_6_HZ)
            case _:
                loss_db = propagation.log_distance_db(start_m, end_m, CHANNEL_6_HZ, self._options.exponent)
        return loss_db if self._shadowing is None else loss_db + self._shadowing.loss_db(start_m, end_m)

    def _obstacles_db(self, start_m: Floats, end_m: Floats) -> Floats:
        if self._world is None:
            return np.zeros(len(start_m))
        return self._world.penetration_loss_db(start_m, end_m, CHANNEL_6_HZ)

    def snr_db(self, transmitter: int, receiver: int) -> float:
        """Return the mean signal-to-noise ratio of a link."""
        return decibel(self._mean_mw[transmitter][receiver] / self.noise_mw[receiver])

    def powers_mw(self, transmitter: int, now_ns: int) -> list[float]:
        """See `RadioChannel.powers_mw`."""
        powers_mw, until_ns = self._now_mw[transmitter]
        if now_ns >= until_ns:
            gains = self._fading.gains(now_ns, self._links_of[transmitter]).tolist()
            gains.insert(transmitter, 0.0)
            powers_mw = [mean * gain for mean, gain in zip(self._mean_mw[transmitter], gains, strict=True)]
            self._now_mw[transmitter] = powers_mw, now_ns + self._kept_ns
        return powers_mw

    def linked(self, transmitter: int, receiver: int) -> bool:
        """See `RadioChannel.linked`; by mean powers, so that a deep fade breaks no association."""
        there, back = self._mean_mw[transmitter][receiver], self._mean_mw[receiver][transmitter]
        return there >= self.sensitivity_mw[receiver] and back >= self.sensitivity_mw[transmitter]

    def delay_ns(self, transmitter: int, receiver: int) -> int:
        """See `RadioChannel.delay_ns`."""
        return self._delays_ns[transmitter][receiver]

    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        """See `RadioChannel.rate_control`."""
        modes = self._modes(transmitter, receiver)
        if self._options.mode is not None:
            return FixedRate(next(mode for mode in modes if mode.name == self._options.mode))
        names = self.names[transmitter], self.names[receiver]
        return Minstrel(modes, self.snr_db(transmitter, receiver), DrawSequence(self._seed, *names, "rate"))

    def _modes(self, transmitter: int, receiver: int) -> tuple[Mode, ...]:
        both = {self._antennas[transmitter].standard, self._antennas[receiver].standard}
        return MODES["802.11n" if both == {"802.11n"} else "802.11g"]


def milliwatt(dbm: float) -> float:
    """Return a power in mW, which is 0 below what a float can tell."""
    return float(10 ** (max(dbm, -3000.0) / 10))
