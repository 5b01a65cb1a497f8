"""Encoding of the link samples of radios in the answer of a network federate."""

import math
import struct
from collections import defaultdict
from collections.abc import Mapping

from fieldkit.core.model import LinkSample, StationSample
from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.frames import FrameReader, MalformedFrameError, count_bytes

_RADIO = struct.Struct("<IIdqq")
_LINK = struct.Struct("<II3d4Q")
_MAX_COUNT = 1 << 62
"""Largest accepted counter; a larger one is an error of the federate."""


def encode_links(samples: Mapping[str, LinkSample], agents: AgentTable) -> bytes:
    """Return the body of the message; an unknown time or counter is 0."""
    radios, links = [], []
    for name, sample in samples.items():
        noise_dbm = _or_nan(sample.noise_dbm)
        radios.append(_RADIO.pack(agents.indices[name], 0, noise_dbm, sample.active_ns or 0, sample.busy_ns or 0))
        for peer in sample.stations:
            numbers = peer.signal_dbm, peer.tx_rate_bit_s, peer.rx_rate_bit_s
            counters = peer.tx_packets, peer.rx_packets, peer.tx_retries, peer.tx_failures
            ends = agents.indices[name], agents.indices[peer.station]
            links.append(_LINK.pack(*ends, *map(_or_nan, numbers), *(count or 0 for count in counters)))
    return count_bytes(len(radios)) + b"".join(radios) + count_bytes(len(links)) + b"".join(links)


def decode_links(body: bytes, agents: AgentTable, utc_ns: int) -> dict[str, LinkSample]:
    """Return the sample of each radio.

    Args:
        body: Body of the message.
        agents: The agents.
        utc_ns: Time of the samples.

    Raises:
        MalformedFrameError: The body is malformed.
    """
    reader = FrameReader(body)
    radios: dict[str, tuple[float, int, int]] = {}
    for _ in range(reader.count(_RADIO.size)):
        position = reader.position
        index, reserved, noise_dbm, active_ns, busy_ns = reader.unpack(_RADIO)
        name = agents.name(index, position)
        if reserved or name in radios or not busy_ns >= 0 or active_ns < 0:
            raise MalformedFrameError(
                position, f"the sample of {name} is repeated, or has a negative time or reserved bits"
            )
        radios[name] = noise_dbm, active_ns, busy_ns
    links: defaultdict[str, list[StationSample]] = defaultdict(list)
    for _ in range(reader.count(_LINK.size)):
        position = reader.position
        index, peer_index, signal_dbm, tx_rate_bit_s, rx_rate_bit_s, *counters = reader.unpack(_LINK)
        name, peer = agents.name(index, position), agents.name(peer_index, position + 4)
        if name not in radios or peer == name or max(counters) > _MAX_COUNT:
            raise MalformedFrameError(
                position,
                f"the link from {name} to {peer} has no sample of its radio, equal ends, or a counter above 2^62",
            )
        rates_bit_s = _or_none(tx_rate_bit_s), _or_none(rx_rate_bit_s)
        links[name].append(StationSample(peer, _or_none(signal_dbm), *rates_bit_s, *counters))
    reader.check_end()
    return {
        name: LinkSample(utc_ns, (*links[name],), None, _or_none(noise_dbm), active_ns, busy_ns)
        for name, (noise_dbm, active_ns, busy_ns) in radios.items()
    }


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _or_none(value: float) -> float | None:
    """Return a number, or None if it is not finite: NaN means unknown."""
    return value if math.isfinite(value) else None
