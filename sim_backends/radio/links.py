"""From where the robots stand to what each directed link does to packets."""

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass
from itertools import permutations

from fieldkit.profiles import Radio
from sim_backends.radio import pathloss
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.parameters import LinkParameters, Pair

Position = tuple[float, float, float]
"""Metres east, north, up."""


@dataclass(frozen=True)
class Station:
    """A robot as the radio sees it.

    Attributes:
        radio: Its radio.
        position_m: Where it stands.
        behind_wall: Whether it stands behind the wall.
    """

    radio: Radio
    position_m: Position
    behind_wall: bool = False


def link_parameters(options: RadioOptions, transmitter: Station, receiver: Station) -> LinkParameters:
    """Return the link from `transmitter` to `receiver`; a wall obstructs it when exactly one of them is behind it.

    Out of range, the link runs at the slowest rate and loses everything.
    """
    distance_m = math.dist(transmitter.position_m, receiver.position_m)
    loss_db = pathloss.log_distance_loss_db(
        distance_m, exponent=options.exponent, reference_loss_db=options.reference_loss_db
    )
    if transmitter.behind_wall != receiver.behind_wall:
        loss_db += options.wall_loss_db
    needed_dbm = pathloss.threshold_dbm(
        sensitivity_dbm=receiver.radio.sensitivity_dbm, noise_floor_dbm=options.noise_floor_dbm
    )
    margin_db = transmitter.radio.tx_power_dbm - loss_db - needed_dbm
    rate_bit_s = pathloss.bit_rate_bit_s(margin_db)
    modelled_loss = 1.0 if rate_bit_s is None else 0.0
    modelled_delay_ns = round(options.processing * 1e9) + pathloss.propagation_delay_ns(distance_m)
    return LinkParameters(
        rate_bit_s=options.rate_bit_s(rate_bit_s or pathloss.BASIC_RATE_BIT_S),
        delay_ns=modelled_delay_ns if options.delay is None else round(options.delay * 1e9),
        jitter_ns=round(options.jitter * 1e9),
        loss=modelled_loss if options.loss is None else options.loss,
        bit_error_rate=pathloss.bit_error_rate(max(margin_db, 0.0)) if options.loss is None else 0.0,
        queue_packets=options.queue_packets,
    )


def mesh(options: RadioOptions, stations: Mapping[str, Station]) -> dict[Pair, LinkParameters]:
    """Return the links between all `stations`, in both directions."""
    return {
        (sender, receiver): link_parameters(options, stations[sender], stations[receiver])
        for sender, receiver in permutations(stations, 2)
    }


def stations_of(
    radios: Mapping[str, Radio], positions_m: Mapping[str, Position], behind_wall: Set[str]
) -> dict[str, Station]:
    """Return the stations of robots placed at `positions_m`; those in `behind_wall` stand behind the wall."""
    return {name: Station(radios[name], at_m, name in behind_wall) for name, at_m in positions_m.items()}
