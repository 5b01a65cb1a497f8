"""The channel between stations that stand or move in a world: path loss, obstacles, fading."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import ne
from typing import Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from fieldkit.config.profiles import Radio
from fieldkit.core.model import Vector
from sim_backends.radio import propagation
from sim_backends.radio.channel import RadioChannel
from sim_backends.radio.fading import Echoes, Fades, Fading, Shadowing
from sim_backends.radio.frames import decibel
from sim_backends.radio.minstrel import Minstrel
from sim_backends.radio.modes import MODES, Standard, WifiMode, fixed_mode, standard_of
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.packet_error import packet_error
from sim_backends.radio.random_streams import PacketDraws
from sim_backends.radio.rate_control import FixedRate, RateControl
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S
from sim_backends.world.motion import STILL
from sim_backends.world.shapes import Floats
from sim_backends.world.world import World

CHANNEL_6_HZ: Final = 2.437e9

# A gain is used for this share of the time in which the echoes turn once.
_KEPT_TURN: Final = 0.02
_SLOWEST_M_S: Final = 1e-6

# So many links cost little more than one, about 0.3 ms among trees; whoever sends next may ask for them.
_TOGETHER: Final = 100


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
    return Antenna(standard_of(radio), float(radio.tx_power_dbm), float(radio.sensitivity_dbm))


class _Row:
    """One station's links to all, by index, as they are until somebody moves.

    Args:
        moves: How often somebody had moved when it was worked out.
        mean_mw: How strong the station arrives at each, without fading, in mW.

    Attributes:
        linked: Whether each hears it and is heard by it, without fading; None before anybody asked.
        slot: The time for which `powers_mw` were worked out, counted in times that a gain is kept.
        powers_mw: How strong the station arrives at each in that time, without fading before any time.
    """

    __slots__ = ("linked", "mean_mw", "moves", "powers_mw", "slot")

    def __init__(self, moves: int, mean_mw: Floats) -> None:
        self.moves = moves
        self.mean_mw = mean_mw
        self.linked: list[bool] | None = None
        self.slot = -1
        self.powers_mw: list[float] = mean_mw.tolist()


class _Faded:
    """The gains of some links, as they are until somebody moves and as long as a gain is kept.

    Args:
        links: Their indices.
        ends: Indices of their first ends, and of their second.
        echoes: How their echoes go.

    Attributes:
        moves: How often somebody had moved when `fades` was worked out.
        fades: How they fade since then.
        slot: The time for which `gains` were worked out.
        gains: What they are in that time, by place among `links`.
    """

    __slots__ = ("echoes", "ends", "fades", "gains", "links", "moves", "slot")

    def __init__(self, links: NDArray[np.int64], ends: NDArray[np.int64], echoes: Echoes) -> None:
        self.links = links
        self.ends = ends
        self.echoes = echoes
        self.moves = self.slot = -1
        self.fades: Fades | None = None
        self.gains = np.empty(0)


class WorldChannel(RadioChannel):
    """The channel between stations that stand, or move, in a world.

    A move costs little: the links of a station are worked out when a frame, or anybody, asks for them. What they are
    then depends on nothing but the time and what was told of places and velocities last.

    Args:
        seed: Of shadowing and fading.
        antennas: The stations.
        options: What the air does.
        world: What stands between them; None for open ground.

    Raises:
        ConfigurationError: All frames are to be of a mode that a station does not have.
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
        self._sent_dbm = np.array([antenna.tx_power_dbm for antenna in self._antennas])
        self._options = options
        self._fixed_mode = fixed_mode(options.mode, {name: antenna.standard for name, antenna in antennas.items()})
        self._world = world
        self._shadowing = (
            Shadowing(seed, options.shadowing_db, options.decorrelation) if options.shadowing_db else None
        )
        count = len(self.names)
        # A link begins at the end whose name sorts first, whatever the order of the stations.
        by_name = np.array(sorted(range(count), key=self.names.__getitem__), dtype=np.int64)
        self._ends = by_name[np.stack(np.triu_indices(count, 1))]
        self._link_of = np.zeros((count, count), dtype=np.int64)
        self._link_of[tuple(self._ends)] = self._link_of[tuple(self._ends[::-1])] = np.arange(self._ends.shape[1])
        self._own_links = [np.delete(links_of, station) for station, links_of in enumerate(self._link_of)]
        self._others = [np.delete(np.arange(count), station) for station in range(count)]
        self._faded: list[_Faded | None] = [None] * count
        self._fading = Fading(
            seed,
            self.names,
            self._ends,
            wavelength_m=SPEED_OF_LIGHT_M_S / CHANNEL_6_HZ,
            stir_m_s=options.stir_m_s,
        )
        self._places: list[Vector | None] = [None] * count
        self._velocities: list[Vector] = [STILL] * count
        self._in_motion = False
        self._cut = np.zeros((count, count), dtype=bool)
        self._present = np.zeros(count, dtype=bool)
        self._places_m, self._velocities_m_s = np.zeros((2, count, 3))
        self._told_ns, self._kept_ns = 0, self._gain_kept_ns()
        self._moves = 0
        self.use_losses(np.full((count, count), np.inf))

    def move(
        self, now_ns: int, places_m: Mapping[str, Vector], velocities_m_s: Mapping[str, Vector] | None = None
    ) -> None:
        """Take it that the stations are at `places_m` now and move with `velocities_m_s`, or stand.

        Who has no place is out of everybody's range. Until something else is told, mean powers stay as they are, and
        stations go on with their velocities as far as fading is concerned, which turns within a wavelength.
        """
        moving = velocities_m_s or {}
        places = list(map(places_m.get, self.names))
        moved = np.array(list(map(ne, places, self._places)), dtype=bool)
        velocities = self._velocities
        if moving or self._in_motion:
            velocities = [moving.get(name, STILL) for name in self.names]
            moved |= list(map(ne, velocities, self._velocities))
        if not moved.any() and not self._in_motion:
            return
        if velocities is not self._velocities:
            self._velocities_m_s = np.array(velocities, dtype=np.float64).reshape(-1, 3)
            self._in_motion = bool(self._velocities_m_s.any())
            self._kept_ns = self._gain_kept_ns()
        self._places, self._velocities = places, velocities
        self._present = np.array([place is not None for place in places])
        self._places_m = np.array([place or STILL for place in places], dtype=np.float64).reshape(-1, 3)
        # Where nobody moves it does not matter since when, and must not, not even by a rounding.
        self._told_ns = now_ns if self._in_motion else 0
        self._moves += 1
        if moved.all():
            self._stale[:] = True
        else:
            first, second = self._ends
            self._stale |= moved[first] | moved[second]

    def cut(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Let these pairs be out of each other's range from now on, and no others but by where they are."""
        index = {name: number for number, name in enumerate(self.names)}
        cut = np.zeros_like(self._cut)
        for one, other in pairs:
            cut[index[one], index[other]] = cut[index[other], index[one]] = True
        self._moves += 1
        self._stale |= (cut != self._cut)[tuple(self._ends)]
        self._cut = cut

    def heard_mw(self, place_m: Vector, power_dbm: float) -> list[float]:
        """Return how strong somebody else who sends from a place is on average at each station, by index."""
        to_m = self._places_m
        loss_db = self.loss_db(np.broadcast_to(place_m, to_m.shape), to_m)
        loss_db[~self._present] = np.inf
        heard_mw: list[float] = _milliwatts(power_dbm - loss_db).tolist()
        return heard_mw

    def _gain_kept_ns(self) -> int:
        """Return how long a gain is used: while the echoes between the two fastest hardly turn."""
        both_m_s = float(np.sort(np.linalg.norm(self._velocities_m_s, axis=1))[-2:].sum())
        turn_s = SPEED_OF_LIGHT_M_S / CHANNEL_6_HZ / max(both_m_s + self._options.stir_m_s, _SLOWEST_M_S)
        return round(_KEPT_TURN * turn_s * 1e9)

    def use_losses(self, loss_db: Floats) -> None:
        """Let paths lose this, from row to column, in dB, until an end of theirs moves; infinity is out of range."""
        self._moves += 1
        self._loss_db = loss_db
        self._k = np.zeros(loss_db.shape)
        self._stale = np.zeros(self._ends.shape[1], dtype=bool)
        self._rows: list[_Row | None] = [None] * len(loss_db)

    def _row(self, station: int) -> _Row:
        """Return the links of a station, worked out now if an end of them moved since they were."""
        row = self._rows[station]
        if row is not None and row.moves == self._moves:
            return row
        self._work_out(station)
        row = _Row(self._moves, _milliwatts(self._sent_dbm[station] - self._loss_db[station]))
        self._rows[station] = row
        return row

    def _gains(self, station: int, slot: int) -> Floats:
        """Return the gains of a station's links in a time, 0 to itself; its row is to be worked out before."""
        faded, own = self._faded_of(station), self._own_links[station]
        if faded.fades is None or faded.moves != self._moves:
            first, second = faded.ends
            start_m, end_m = self._places_m[first], self._places_m[second]
            velocities_m_s = (self._velocities_m_s[first], self._velocities_m_s[second]) if self._in_motion else None
            faded.fades = faded.echoes.fades(start_m, end_m, velocities_m_s, self._k[first, second], self._told_ns)
            faded.moves, faded.slot = self._moves, -1
        if faded.slot != slot:
            faded.gains = faded.fades.gains((slot * self._kept_ns - self._told_ns) * 1e-9)
            faded.slot = slot
        gains = np.zeros(len(self.names))
        gains[self._others[station]] = faded.gains if faded.links is own else faded.gains[own]
        return gains

    def _faded_of(self, station: int) -> _Faded:
        faded = self._faded[station]
        if faded is None:
            # An answer needs the same gain as what it answers, so that few links are worked out together.
            together = self._ends.shape[1] <= _TOGETHER
            links = np.arange(self._ends.shape[1]) if together else self._own_links[station]
            faded = _Faded(links, self._ends[:, links], self._fading.echoes(links))
            if together:
                self._faded = [faded] * len(self.names)
            else:
                self._faded[station] = faded
        return faded

    def _work_out(self, station: int) -> None:
        """Work out the links of a station that are stale, and all others with them while they are few."""
        own = self._own_links[station]
        stale = own[self._stale[own]]
        if not len(stale):
            return
        if np.count_nonzero(self._stale) <= _TOGETHER:
            stale = np.flatnonzero(self._stale)
        first, second = self._ends[:, stale]
        start, end = self._places_m[first], self._places_m[second]
        obstacles_db = self._obstacles_db(start, end)
        loss_db = self._open_db(start, end) + obstacles_db
        loss_db[~(self._present[first] & self._present[second]) | self._cut[first, second]] = np.inf
        # Whatever stands in the way takes something, and the steady wave.
        k = np.where(obstacles_db == 0, 10 ** (self._options.k_db / 10), 0.0)
        for table, values in ((self._loss_db, loss_db), (self._k, k)):
            table[first, second] = table[second, first] = values
        self._stale[stale] = False

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
        return decibel(float(self._row(transmitter).mean_mw[receiver]) / self.noise_mw[receiver])

    @override
    def powers_mw(self, transmitter: int, now_ns: int) -> list[float]:
        row = self._row(transmitter)
        if not self._options.fading:
            return row.powers_mw
        slot = now_ns // self._kept_ns
        if slot != row.slot:
            row.powers_mw = (row.mean_mw * self._gains(transmitter, slot)).tolist()
            row.slot = slot
        return row.powers_mw

    @override
    def linked(self, transmitter: int, receiver: int) -> bool:
        """By mean powers, so that a deep fade breaks no association."""
        row = self._row(transmitter)
        if row.linked is None:
            back_mw = _milliwatts(self._sent_dbm - self._loss_db[transmitter])
            hears_mw = self.sensitivity_mw[transmitter]
            row.linked = ((row.mean_mw >= self.sensitivity_mw) & (back_mw >= hears_mw)).tolist()
        return row.linked[receiver]

    @override
    def delay_ns(self, transmitter: int, receiver: int) -> int:
        one, other = self._places[transmitter], self._places[receiver]
        return round(math.dist(one or STILL, other or STILL) / SPEED_OF_LIGHT_M_S * 1e9)

    @override
    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        if self._fixed_mode is not None:
            return FixedRate(self._fixed_mode)
        names = self.names[transmitter], self.names[receiver]
        return Minstrel(
            self._modes(transmitter, receiver),
            self.snr_db(transmitter, receiver),
            PacketDraws(self._seed, *names, "rate"),
        )

    def _modes(self, transmitter: int, receiver: int) -> tuple[WifiMode, ...]:
        both = {self._antennas[transmitter].standard, self._antennas[receiver].standard}
        return MODES["802.11n" if both == {"802.11n"} else "802.11g"]


def milliwatt(dbm: float) -> float:
    """Return a power in mW, which is 0 below what a float can tell."""
    return float(10 ** (max(dbm, -3000.0) / 10))


def _milliwatts(dbm: Floats) -> Floats:
    powers: Floats = 10 ** (dbm / 10)
    return powers
