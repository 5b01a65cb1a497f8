"""The channel between stations that are placed or move in a world: path loss, obstacles, fading."""

import math
from collections.abc import Iterable, Mapping
from operator import ne
from typing import Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from fieldkit.config.wifi_phy import DscpMapping
from fieldkit.core.model import Vector
from fieldkit.core.seeds import place_seed
from sim_backends.radio.antennas import Antenna, band_of, fixed_mode, modes_between
from sim_backends.radio.core.random_streams import PacketDraws
from sim_backends.radio.mac.aggregation import AMPDU_LIMITS, TYPICAL_FRAMES, AmpduLimits
from sim_backends.radio.mac.amsdu import limits_with_amsdu
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mean_loss import MeanLoss
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import common_modes, mode_groups
from sim_backends.radio.phy.modes import OFDM_MODES
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.propagation.fading import Fading
from sim_backends.radio.propagation.link_caches import GainCache, LinkRow
from sim_backends.radio.propagation.station_gains import StationGains
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.rate_control.firmware_rate import FirmwareRate
from sim_backends.radio.rate_control.minstrel import Minstrel
from sim_backends.radio.rate_control.minstrel_ht import MinstrelHt
from sim_backends.radio.rate_control.rate_control import FixedRate, RateControl
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S
from sim_backends.world.motion import STILL, Attitude
from sim_backends.world.shapes import Floats
from sim_backends.world.world import World

# A gain is used for this share of the shortest period of an echo's phase.
_GAIN_VALID_PERIODS: Final = 0.02
_SLOWEST_M_S: Final = 1e-6  # avoids a division by 0 if nothing moves

# Number of links that are computed together. This takes little longer than one link (about 0.3 ms among trees), and
# the next sender may need the other links.
_BATCH_LINKS: Final = 100


class WorldChannel(RadioChannel):
    """The channel between stations that are placed or move in a world.

    A move takes little time, because the links of a station are computed when a frame, or another caller, needs them.
    The result depends only on the time and the last positions and velocities.

    Args:
        seed: Seed of shadowing and fading.
        antennas: The stations.
        options: Radio options.
        world: Obstacles between the stations; None for open ground.

    Raises:
        ConfigurationError: `options.mode` is a mode that a station does not support, or the bands differ.
    """

    def __init__(
        self, seed: int, antennas: Mapping[str, Antenna], options: RadioOptions, world: World | None = None
    ) -> None:
        self.band = band_of(antennas)
        # The error tables are computed now, not when the first frames wait for them.
        for antenna in set(antennas.values()):
            for mode in (*OFDM_MODES[self.band.name], *modes_between(antenna, antenna)):
                packet_error(mode, 0.0, 1)
        self.names = tuple(antennas)
        self.noise_mw = [milliwatt(options.noise_floor_dbm)] * len(self.names)
        self.sensitivity_mw = [milliwatt(antenna.sensitivity_dbm) for antenna in antennas.values()]
        self._seed = seed
        self._antennas = tuple(antennas.values())
        self._tx_powers_dbm = np.array([antenna.tx_power_dbm for antenna in self._antennas])
        self._options = options
        self._fixed_mode = fixed_mode(options.mode, antennas)
        self._mean_loss = MeanLoss(options, self.band.carrier_hz, world, place_seed(seed))
        patterns = [antenna.pattern for antenna in self._antennas]
        self._station_gains = StationGains(self.names, patterns) if any(patterns) else None
        count = len(self.names)
        # The first end of a link is the one whose name sorts first, for any order of the stations.
        by_name = np.array(sorted(range(count), key=self.names.__getitem__), dtype=np.int64)
        self._ends = by_name[np.stack(np.triu_indices(count, 1))]
        # Index of the link between two stations, the same in both directions.
        self._link_of = np.zeros((count, count), dtype=np.int64)
        self._link_of[tuple(self._ends)] = self._link_of[tuple(self._ends[::-1])] = np.arange(self._ends.shape[1])
        self._links_of_station = [np.delete(links_of, station) for station, links_of in enumerate(self._link_of)]
        self._others = [np.delete(np.arange(count), station) for station in range(count)]
        self._gain_caches: list[GainCache | None] = [None] * count
        self._fading = Fading(
            seed,
            self.names,
            self._ends,
            wavelength_m=SPEED_OF_LIGHT_M_S / self.band.carrier_hz,
            stir_m_s=options.stir_m_s,
        )
        self._positions: list[Vector | None] = [None] * count
        self._velocities: list[Vector] = [STILL] * count
        self._in_motion = False  # True if a station has a velocity
        # True for each pair of stations that cannot receive each other at any distance.
        self._cut = np.zeros((count, count), dtype=bool)
        # Losses of `use_path_losses`; NaN for paths whose losses are computed.
        self._specified_db: Floats | None = None
        self._present = np.zeros(count, dtype=bool)  # True for each station that has a position
        self._positions_m, self._velocities_m_s = np.zeros((2, count, 3))
        # Time of the positions, and time for which a fading gain is used.
        self._moved_ns, self._gain_valid_ns = 0, self._compute_gain_valid_ns()
        self._revision = 0  # increases with each change of positions, velocities, cuts or losses
        self.use_losses(np.full((count, count), np.inf))

    @property
    def uses_attitudes(self) -> bool:
        """True if the gain of a station depends on its attitude."""
        return self._station_gains is not None

    def move(
        self,
        now_ns: int,
        positions_m: Mapping[str, Vector],
        velocities_m_s: Mapping[str, Vector] | None = None,
        attitudes: Mapping[str, Attitude] | None = None,
    ) -> None:
        """Set the current positions, velocities and attitudes; a station without a new attitude keeps its last one.

        Stations without a position are out of range of all others. Until the next call, mean powers do not change;
        only fading, which changes within a wavelength, extrapolates with the velocities.
        """
        velocities_by_name = velocities_m_s or {}
        positions = list(map(positions_m.get, self.names))
        has_moved = np.array(list(map(ne, positions, self._positions)), dtype=bool)
        velocities = self._velocities
        if velocities_by_name or self._in_motion:
            velocities = [velocities_by_name.get(name, STILL) for name in self.names]
            has_moved |= list(map(ne, velocities, self._velocities))
        if self._station_gains is not None and attitudes:
            has_moved[self._station_gains.orient(attitudes)] = True
        if not has_moved.any() and not self._in_motion:
            return
        if velocities is not self._velocities:
            self._velocities_m_s = np.array(velocities, dtype=np.float64).reshape(-1, 3)
            self._in_motion = bool(self._velocities_m_s.any())
            self._gain_valid_ns = self._compute_gain_valid_ns()
        self._positions, self._velocities = positions, velocities
        self._present = np.array([position is not None for position in positions])
        self._positions_m = np.array([position or STILL for position in positions], dtype=np.float64).reshape(-1, 3)
        # If no station moves, the result must not depend on the time, not even by rounding.
        self._moved_ns = now_ns if self._in_motion else 0
        self._revision += 1
        if has_moved.all():
            self._stale[:] = True
        else:
            first, second = self._ends
            self._stale |= has_moved[first] | has_moved[second]

    def cut(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Set the pairs of stations that are out of range of each other regardless of their positions."""
        index = {name: number for number, name in enumerate(self.names)}
        cut = np.zeros_like(self._cut)
        for first, second in pairs:
            cut[index[first], index[second]] = cut[index[second], index[first]] = True
        self._revision += 1
        self._stale |= (cut != self._cut)[tuple(self._ends)]
        self._cut = cut

    def use_path_losses(self, losses_db: Mapping[tuple[str, str], float]) -> None:
        """Set the mean losses of some paths, from transmitter to receiver, which replace the computed losses.

        They also replace shadowing, obstacles and antenna gains.

        Args:
            losses_db: The losses in dB; losses of other paths are computed from the positions.
        """
        count = len(self.names)
        index = {name: number for number, name in enumerate(self.names)}
        specified_db, previous_db = np.full((count, count), np.nan), self._specified_db
        for (transmitter, receiver), loss_db in losses_db.items():
            if transmitter in index and receiver in index:
                specified_db[index[transmitter], index[receiver]] = loss_db
        if previous_db is None:
            previous_db = np.full((count, count), np.nan)
        is_unchanged = (specified_db == previous_db) | (np.isnan(specified_db) & np.isnan(previous_db))
        if is_unchanged.all():
            return
        self._specified_db = specified_db
        self._revision += 1
        self._stale |= ~(is_unchanged & is_unchanged.T)[tuple(self._ends)]

    def received_mw(self, position_m: Vector, power_dbm: float) -> list[float]:
        """Return the mean power, by index, that each station receives from another transmitter at a position."""
        to_m = self._positions_m
        loss_db = self.loss_db(np.broadcast_to(position_m, to_m.shape), to_m)
        if self._station_gains is not None:
            loss_db -= self._station_gains.direct_dbi(np.arange(len(to_m)), np.array(position_m) - to_m)
        loss_db[~self._present] = np.inf
        received_mw: list[float] = _milliwatts(power_dbm - loss_db).tolist()
        return received_mw

    def _compute_gain_valid_ns(self) -> int:
        """Return the time for which a gain is used: 2 % of an echo's period between the two fastest stations."""
        closing_m_s = float(np.sort(np.linalg.norm(self._velocities_m_s, axis=1))[-2:].sum())
        period_s = SPEED_OF_LIGHT_M_S / self.band.carrier_hz / max(closing_m_s + self._options.stir_m_s, _SLOWEST_M_S)
        return round(_GAIN_VALID_PERIODS * period_s * 1e9)

    def use_losses(self, loss_db: Floats) -> None:
        """Use these losses in dB (rows: transmitters, columns: receivers) until an end moves; inf is out of range."""
        self._revision += 1
        self._loss_db = loss_db
        self._rician_k = np.zeros(loss_db.shape)
        # True for each link whose loss must be computed again, because an end has moved or the link was cut.
        self._stale = np.zeros(self._ends.shape[1], dtype=bool)
        self._rows: list[LinkRow | None] = [None] * len(loss_db)

    def _row(self, station: int) -> LinkRow:
        """Return the links of a station, computed again if one of their ends has moved."""
        row = self._rows[station]
        if row is not None and row.revision == self._revision:
            return row
        self._update_links(station)
        row = LinkRow(self._revision, _milliwatts(self._tx_powers_dbm[station] - self._loss_db[station]))
        self._rows[station] = row
        return row

    def _gains(self, station: int, slot: int) -> Floats:
        """Return the gains of a station's links in a time slot, 0 to itself; `_row` must have been called before."""
        cache, station_links = self._gain_cache(station), self._links_of_station[station]
        if cache.fades is None or cache.revision != self._revision:
            first, second = cache.ends
            start_m, end_m = self._positions_m[first], self._positions_m[second]
            velocities_m_s = (self._velocities_m_s[first], self._velocities_m_s[second]) if self._in_motion else None
            cache.fades = cache.echoes.fades(
                start_m, end_m, velocities_m_s, self._rician_k[first, second], self._moved_ns
            )
            cache.revision, cache.slot = self._revision, -1
        if cache.slot != slot:
            cache.gains = cache.fades.gains((slot * self._gain_valid_ns - self._moved_ns) * 1e-9)
            cache.slot = slot
        gains = np.zeros(len(self.names))
        gains[self._others[station]] = cache.gains if cache.links is station_links else cache.gains[station_links]
        return gains

    def _gain_cache(self, station: int) -> GainCache:
        cache = self._gain_caches[station]
        if cache is None:
            # An ACK needs the same gain as its data frame, so if there are few links they are computed together.
            has_few_links = self._ends.shape[1] <= _BATCH_LINKS
            links = np.arange(self._ends.shape[1]) if has_few_links else self._links_of_station[station]
            cache = GainCache(links, self._ends[:, links], self._fading.echoes(links))
            if has_few_links:
                self._gain_caches = [cache] * len(self.names)
            else:
                self._gain_caches[station] = cache
        return cache

    def _update_links(self, station: int) -> None:
        """Compute the stale links of a station, and all other stale links too if there are few."""
        station_links = self._links_of_station[station]
        stale = station_links[self._stale[station_links]]
        if not len(stale):
            return
        if np.count_nonzero(self._stale) <= _BATCH_LINKS:
            stale = np.flatnonzero(self._stale)
        first, second = self._ends[:, stale]
        start, end = self._positions_m[first], self._positions_m[second]
        obstacles_db = self._mean_loss.obstacles_db(start, end)
        # Any obstacle on the path adds loss and removes the constant component.
        k = np.where(obstacles_db == 0, 10 ** (self._options.k_db / 10), 0.0)
        loss_db = reverse_db = self._mean_loss.loss_without_obstacles_db(start, end) + obstacles_db
        if self._station_gains is not None:
            k = self._add_antennas(stale, loss_db, k)
        if self._specified_db is not None:
            specified_db = self._specified_db[first, second], self._specified_db[second, first]
            loss_db, reverse_db = (np.where(np.isnan(values), loss_db, values) for values in specified_db)
        out_of_range = ~(self._present[first] & self._present[second]) | self._cut[first, second]
        loss_db[out_of_range] = reverse_db[out_of_range] = np.inf
        self._loss_db[first, second], self._loss_db[second, first] = loss_db, reverse_db
        self._rician_k[first, second] = self._rician_k[second, first] = k
        self._stale[stale] = False

    def _add_antennas(self, links: NDArray[np.int64], loss_db: Floats, k: Floats) -> Floats:
        """Subtract the antenna gains of links from their losses; return the K factors with these gains.

        The direct path, K / (K + 1) of the power, has the gains in its direction; the echoes have their mean gain.
        """
        assert self._station_gains is not None
        first, second = self._ends[:, links]
        path_m = self._positions_m[second] - self._positions_m[first]
        direct, echoes = self._station_gains.link_gains(first, second, path_m)
        gains = (k * direct + echoes) / (k + 1) if self._options.fading else direct
        loss_db -= 10 * np.log10(gains)
        return k * direct / echoes

    def loss_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the mean loss of paths between points of shape (n, 3), with shadowing and obstacles, in dB."""
        return self._mean_loss.loss_db(start_m, end_m)

    def snr_db(self, transmitter: int, receiver: int) -> float:
        """Return the mean signal-to-noise ratio of a link."""
        return decibel(float(self._row(transmitter).mean_mw[receiver]) / self.noise_mw[receiver])

    @override
    def powers_mw(self, transmitter: int, now_ns: int) -> list[float]:
        row = self._row(transmitter)
        if not self._options.fading:
            return row.powers_mw
        slot = now_ns // self._gain_valid_ns
        if slot != row.slot:
            row.powers_mw = (row.mean_mw * self._gains(transmitter, slot)).tolist()
            row.slot = slot
        return row.powers_mw

    @override
    def are_linked(self, transmitter: int, receiver: int) -> bool:
        """Compare the mean powers with the sensitivities, so that a deep fade does not end an association."""
        row = self._row(transmitter)
        if row.is_linked is None:
            reverse_mw = _milliwatts(self._tx_powers_dbm - self._loss_db[:, transmitter])
            sensitivity_mw = self.sensitivity_mw[transmitter]
            row.is_linked = ((row.mean_mw >= self.sensitivity_mw) & (reverse_mw >= sensitivity_mw)).tolist()
        return row.is_linked[receiver]

    @override
    def delay_ns(self, transmitter: int, receiver: int) -> int:
        first, second = self._positions[transmitter], self._positions[receiver]
        return round(math.dist(first or STILL, second or STILL) / SPEED_OF_LIGHT_M_S * 1e9)

    @override
    def ifs_ns(self, station: int) -> int:
        return self.band.difs_ns if self._antennas[station].phy is None else self.band.best_effort_aifs_ns

    @override
    def rts_threshold_bytes(self, station: int) -> int | None:
        phy = self._antennas[station].phy
        return None if phy is None else phy.rts_threshold_bytes

    @override
    def dscp_mapping(self, station: int) -> DscpMapping | None:
        phy = self._antennas[station].phy
        return None if phy is None else phy.access_categories

    @override
    def power_save_timeout_ns(self, station: int) -> int | None:
        phy = self._antennas[station].phy
        return None if phy is None else phy.power_save_timeout_ns

    @override
    def packet_time_ns(self, station: int) -> int:
        phy = self._antennas[station].phy
        return 0 if phy is None else phy.packet_time_ns

    @override
    def ampdu_limits(self, transmitter: int, receiver: int) -> AmpduLimits | None:
        first, second = self._antennas[transmitter], self._antennas[receiver]
        if (
            first.phy is None
            or second.phy is None
            or (self._fixed_mode is not None and not self._fixed_mode.is_high_throughput)
        ):
            return None
        mode = self._fixed_mode or common_modes(first.phy, second.phy)[0]
        if first.phy.amsdu_max_bytes is None or second.phy.amsdu_max_bytes is None:
            return AMPDU_LIMITS[mode.phy_format]
        return limits_with_amsdu(mode.phy_format, min(first.phy.amsdu_max_bytes, second.phy.amsdu_max_bytes))

    @override
    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        if self._fixed_mode is not None:
            return FixedRate(self._fixed_mode)
        names = self.names[transmitter], self.names[receiver]
        draws = PacketDraws(self._seed, *names, "rate")
        first, second = self._antennas[transmitter], self._antennas[receiver]
        if first.phy is not None and second.phy is not None:
            if first.phy.rate_control == "minstrel_ht":
                return MinstrelHt(mode_groups(first.phy, second.phy), draws)
            if first.phy.rate_control == "firmware":
                return FirmwareRate(
                    common_modes(first.phy, second.phy),
                    lambda now_ns: decibel(
                        self.powers_mw(receiver, now_ns)[transmitter] / self.noise_mw[transmitter]
                    ),
                    margin_db=first.phy.firmware_margin_db,
                    interval_ns=first.phy.firmware_interval_ns,
                )
        return Minstrel(
            modes_between(first, second),
            self.snr_db(transmitter, receiver),
            draws,
            frames_per_exchange=1 if self.ampdu_limits(transmitter, receiver) is None else TYPICAL_FRAMES,
        )


def milliwatt(dbm: float) -> float:
    """Return a power in mW; powers below -3000 dBm are returned as 1e-300 mW."""
    return float(10 ** (max(dbm, -3000.0) / 10))


def _milliwatts(dbm: Floats) -> Floats:
    powers: Floats = 10 ** (dbm / 10)
    return powers
