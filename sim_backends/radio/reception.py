"""Reception of transmissions: carrier sense, the preamble that a station follows, what it decodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import ge
from typing import Final, Generic

from sim_backends.radio.channel import RadioChannel
from sim_backends.radio.contention import BLIND_NS
from sim_backends.radio.delay import Payload
from sim_backends.radio.event_queue import EventQueue
from sim_backends.radio.frames import PREAMBLE_SNR_DB, Emission, Transmission, success
from sim_backends.radio.modes import BASIC, DIFS_NS, ENERGY_DETECTION_DBM, SIFS_NS, ack_ns
from sim_backends.radio.random_streams import PacketDraws
from sim_backends.radio.stations import Station

_EIFS_EXTRA_NS: Final = SIFS_NS + ack_ns(BASIC)
_DETECTABLE_RATIO: Final = 10 ** (PREAMBLE_SNR_DB / 10)
_ENERGY_DETECTION_MW: Final = 10 ** (ENERGY_DETECTION_DBM / 10)


@dataclass(frozen=True, slots=True)
class _Reach:
    """How far a transmitter reaches, as long as its powers hold.

    Attributes:
        powers_mw: As `RadioChannel.powers_mw` returned them.
        heard_by: Indices of the stations that a frame of it keeps from sending.
    """

    powers_mw: list[float]
    heard_by: Sequence[int]


class Reception(Generic[Payload]):
    """The frames on one channel, and the ears of all stations.

    Args:
        channel: How they hear each other.
        seed: Of the draws that decide what is decoded.
        stations: By index.
        events: When stations that wait to send begin to; they begin later when they hear a frame.
    """

    def __init__(
        self,
        channel: RadioChannel,
        seed: int,
        stations: Sequence[Station[Payload]],
        events: EventQueue,
    ) -> None:
        self._channel = channel
        self._seed = seed
        self._stations = stations
        self._events = events
        self._on_air: list[Transmission] = []
        self._emissions: dict[str, Emission] = {}
        self._draws: dict[tuple[int, int, str], PacketDraws] = {}
        self._reaches: dict[int, _Reach] = {}

    def begin(self, transmission: Transmission, reserved_ns: int) -> None:
        """Put a frame on the air; who hears it keeps silent until `reserved_ns`."""
        station, now_ns, end_ns = self._stations[transmission.transmitter], transmission.start_ns, transmission.end_ns
        reach = self._reach(transmission.transmitter, now_ns)
        transmission.powers_mw, transmission.heard_by = reach.powers_mw, reach.heard_by
        before = self._on_air
        for other in before:
            other.others.append(transmission)
        transmission.others.extend(before)
        transmission.others.extend(self._emissions.values())
        if station.following is not None:
            station.following.followed_by.discard(station.index)
            station.following = None
        station.sending_until_ns = end_ns
        station.contention.sent(end_ns)
        stations, events, beginnings = self._stations, self._events, self._events.beginnings
        alone, powers_mw, noise_mw = not transmission.others, reach.powers_mw, self._channel.noise_mw
        follow = transmission.followed_by.add
        sensed_ns = now_ns + BLIND_NS
        for index in reach.heard_by:
            hearer = stations[index]
            if hearer.following is None and hearer.sending_until_ns <= now_ns:
                others_mw = 0.0 if alone else sum([other.powers_mw[index] for other in transmission.others])
                if powers_mw[index] >= (noise_mw[index] + others_mw) * _DETECTABLE_RATIO:
                    hearer.following = transmission
                    follow(index)
            beginning = beginnings.get(index)
            if beginning is None:
                hearer.contention.sensed(now_ns, reserved_ns)
            elif beginning[0] > sensed_ns:
                events.begin(hearer.contention.postponed(now_ns, reserved_ns), index)
        before.append(transmission)

    def end(self, now_ns: int, transmission: Transmission) -> None:
        """Take a frame off the air; who heard it without understanding it waits for an ACK that it could not see."""
        self._on_air.remove(transmission)
        for index in transmission.followed_by:
            self._stations[index].following = None
        if transmission.others:
            until_ns = now_ns + _EIFS_EXTRA_NS + DIFS_NS
            for index in transmission.heard_by:
                hearer = self._stations[index]
                if index not in transmission.followed_by and hearer.sending_until_ns < now_ns:
                    hearer.contention.deferred(until_ns)
                    if index in self._events.beginnings:
                        self._events.begin(hearer.contention.wanted(now_ns), index)
            transmission.others.clear()

    def silence(self, index: int, now_ns: int) -> None:
        """Break off what a station sends, so that nobody decodes it, and what it receives."""
        station = self._stations[index]
        if station.following is not None:
            station.following.followed_by.discard(index)
            station.following = None
        for transmission in self._on_air:
            if transmission.transmitter == index:
                for follower in transmission.followed_by:
                    self._stations[follower].following = None
                transmission.followed_by.clear()
        station.sending_until_ns = min(station.sending_until_ns, now_ns)

    def jam(self, now_ns: int, emissions: Mapping[str, Emission]) -> None:
        """Let nothing but this noise be on the air from now on, by who sends it; the same noise may change."""
        for name, emission in self._emissions.items():
            if name not in emissions:
                emission.end_ns = now_ns
        kept = {name: self._emissions.get(name, emission) for name, emission in emissions.items()}
        for name, emission in kept.items():
            if name not in self._emissions:
                for transmission in self._on_air:
                    transmission.others.append(emission)
            emission.powers_mw = emissions[name].powers_mw
        self._emissions = kept

    def jammed(self, index: int) -> bool:
        """Return whether a station finds so much noise of jammers that it does not send."""
        emissions = self._emissions.values()
        return bool(emissions) and sum(emission.powers_mw[index] for emission in emissions) >= _ENERGY_DETECTION_MW

    def decodes(self, index: int, transmission: Transmission, purpose: str) -> bool:
        """Return whether a station decodes a frame whose end has come; to be asked once, before `end`.

        Args:
            index: Of the station.
            transmission: Of the frame.
            purpose: Names the stream of draws: frames of data and ACKs have fates of their own.
        """
        if index not in transmission.followed_by:
            return False
        return self._fate(transmission, index, purpose) < success(transmission, index, self._channel.noise_mw[index])

    def _reach(self, transmitter: int, now_ns: int) -> _Reach:
        powers_mw = self._channel.powers_mw(transmitter, now_ns)
        known = self._reaches.get(transmitter)
        if known is not None and known.powers_mw is powers_mw:
            return known
        heard = map(ge, powers_mw, self._channel.sensitivity_mw)
        heard_by = [index for index, hears in enumerate(heard) if hears and index != transmitter]
        known = self._reaches[transmitter] = _Reach(powers_mw, heard_by)
        return known

    def _fate(self, transmission: Transmission, receiver: int, purpose: str) -> float:
        key = transmission.transmitter, receiver, purpose
        draws = self._draws.get(key)
        if draws is None:
            names = self._channel.names
            draws = PacketDraws(self._seed, names[transmission.transmitter], names[receiver], purpose)
            self._draws[key] = draws
        return draws.draw(transmission.packet, transmission.attempt)
