"""Reception of transmissions: carrier sense, synchronization to a preamble, and decoding."""

import math
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from operator import ge, truediv
from typing import Final, Generic

from sim_backends.radio.core.links import Payload
from sim_backends.radio.core.random_streams import PacketDraws
from sim_backends.radio.mac.aggregation import QOS_HEADER_BYTES, Aggregate
from sim_backends.radio.mac.amsdu import frame_bytes, frames_of
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.contention import CCA_TIME_NS, EventQueue
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.mac.overhearing import (
    LARGEST_MAGNITUDE,
    always_decoded_ratio,
    certain_ratios,
    decoding_probability,
)
from sim_backends.radio.mac.stations import Station
from sim_backends.radio.phy.modes import ENERGY_DETECTION_DBM, WifiMode, ack_ns, basic_mode
from sim_backends.radio.phy.transmissions import (
    PREAMBLE_SNR_DB,
    Emission,
    Transmission,
    part_success_probability,
    success_probability,
)

_DETECTABLE_RATIO: Final = 10 ** (PREAMBLE_SNR_DB / 10)
"""Smallest ratio of a preamble to noise and interference at which a station detects the preamble."""
_ENERGY_DETECTION_MW: Final = 10 ** (ENERGY_DETECTION_DBM / 10)


@dataclass(frozen=True, slots=True)
class _Reach:
    """The stations that a transmitter reaches, valid while its received powers do not change.

    Attributes:
        powers_mw: The list returned by `RadioChannel.powers_mw`.
        detected_by: Indices of the stations that detect its frames and therefore do not send.
        weakest_ratio: Smallest ratio of its power to the noise at these stations; infinite if there are none.
    """

    powers_mw: list[float]
    detected_by: Sequence[int]
    weakest_ratio: float


class Reception(Generic[Payload]):
    """The frames on one channel, and their reception at all stations.

    Args:
        channel: Received powers between the stations.
        seed: Seed of the draws that decide which frames are decoded.
        stations: Stations by index.
        events: Scheduled starts of waiting stations, which are postponed when they detect a frame.
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
        band = channel.band
        # Time by which EIFS is longer than the inter-frame space of a station.
        self._eifs_extra_ns = band.sifs_ns + ack_ns(basic_mode(band))
        self._on_air: list[Transmission] = []
        self._emissions: dict[str, Emission] = {}
        self._draws: dict[tuple[int, int, str], PacketDraws] = {}
        self._reaches: dict[int, _Reach] = {}
        # Latest end of EIFS, and the end for each station that did not decode a frame, without inter-frame space.
        self._eifs_ends_ns = 0
        self._deferring: dict[int, int] = {}
        # Stations that have decoded, or not, the frame that ends now.
        self._results: dict[int, bool] = {}
        self._has_failed = False  # True if one of these stations has not decoded it
        self._always_ratios: dict[WifiMode, float] = {}  # results of `_always_decoded_ratio`

    def start(self, transmission: Transmission, reserved_ns: int) -> None:
        """Start a transmission; stations that detect it do not send until `reserved_ns`.

        A station that starts within `CCA_TIME_NS` has not sensed the transmission yet, and sends too.
        """
        station, now_ns, end_ns = self._stations[transmission.transmitter], transmission.start_ns, transmission.end_ns
        reach = self._reach(transmission.transmitter, now_ns)
        transmission.powers_mw, transmission.detected_by = reach.powers_mw, reach.detected_by
        transmission.weakest_ratio = reach.weakest_ratio
        on_air = self._on_air
        for other in on_air:
            other.interferers.append(transmission)
        transmission.interferers.extend(on_air)
        transmission.interferers.extend(self._emissions.values())
        if station.receiving is not None:  # a station that sends stops receiving
            station.receiving.receivers.discard(station.index)
            station.receiving = None
        station.sending_until_ns = end_ns
        station.contention.set_busy_until(end_ns)
        stations, events, starts = self._stations, self._events, self._events.starts
        powers_mw, noise_mw = reach.powers_mw, self._channel.noise_mw
        has_no_interference = not transmission.interferers
        add_receiver = transmission.receivers.add
        sensed_ns = now_ns + CCA_TIME_NS
        for index in reach.detected_by:
            neighbour = stations[index]
            if neighbour.receiving is None and neighbour.sending_until_ns <= now_ns:
                others_mw = (
                    0.0
                    if has_no_interference
                    else sum([other.powers_mw[index] for other in transmission.interferers])
                )
                if powers_mw[index] >= (noise_mw[index] + others_mw) * _DETECTABLE_RATIO:
                    neighbour.receiving = transmission
                    add_receiver(index)
            scheduled_start = starts.get(index)
            if scheduled_start is None:
                neighbour.contention.on_busy(now_ns, reserved_ns)
            elif scheduled_start[0] > sensed_ns:  # otherwise the station starts before it senses this frame
                events.schedule_start(neighbour.contention.postpone(now_ns, reserved_ns), index)
        on_air.append(transmission)

    def end(
        self, now_ns: int, transmission: Transmission, *, reserved_ns: int = 0, is_answered: bool = False
    ) -> None:
        """End a transmission.

        Stations that detected it and did not decode it defer their next frame (EIFS). At a station that decoded it,
        an earlier EIFS ends, and the channel is reserved.

        Args:
            now_ns: Current time.
            transmission: The transmission.
            reserved_ns: End of the reservation; 0 if `start` has made it.
            is_answered: True if its receiver has decoded it and will respond. EIFS after it then starts with
                `start_response`.
        """
        self._on_air.remove(transmission)
        receivers: Set[int] = transmission.receivers
        stations = self._stations
        for index in receivers:
            stations[index].receiving = None
        # Most frames: all stations have decoded it, and no station waits for EIFS.
        if (
            not transmission.interferers
            and transmission.weakest_ratio >= self._always_decoded_ratio(transmission.mode)
            and self._eifs_ends_ns <= now_ns
            and not reserved_ns
            and not self._has_failed
        ):
            self._results.clear()
            return
        if transmission.interferers:
            undetermined = self._defer_unsynchronized(now_ns, transmission)
            if not reserved_ns:
                receivers = receivers - undetermined
        if is_answered:
            decoded = receivers & self._results.keys()
            transmission.undetermined = receivers - decoded
            self._use_decoded(now_ns, decoded, 0)
        else:
            self._determine(now_ns, transmission, receivers, reserved_ns)
        self._results.clear()
        self._has_failed = False

    def start_response(self, transmission: Transmission, response: Transmission | None) -> None:
        """Start the response to a transmission, or only EIFS after the transmission if there is no response.

        Stations that are synchronized to the response do not need EIFS after the transmission: they cannot send
        before the end of the response, and its decoding determines their EIFS.
        """
        undetermined = transmission.undetermined
        if response is not None:
            self.start(response, response.end_ns)
            undetermined = undetermined - response.receivers
        if undetermined:
            self._determine(transmission.end_ns, transmission, undetermined, 0)
        transmission.interferers.clear()

    def _determine(self, now_ns: int, transmission: Transmission, receivers: Set[int], reserved_ns: int) -> None:
        """Determine which receivers have decoded a transmission that has ended; start or end their EIFS."""
        undecoded = self._undecoded(transmission, receivers)
        for index in undecoded:
            self._defer(now_ns, index, transmission.end_ns)
        if reserved_ns or self._eifs_ends_ns > now_ns:
            self._use_decoded(now_ns, receivers - set(undecoded), reserved_ns)
        transmission.interferers.clear()

    def _always_decoded_ratio(self, mode: WifiMode) -> float:
        """Return the ratio of signal to noise in 20 MHz at which a station certainly decodes any frame in a mode."""
        ratio = self._always_ratios.get(mode)
        if ratio is None:
            ratio = self._always_ratios[mode] = certain_ratios(mode, LARGEST_MAGNITUDE)[1]
        return ratio

    def _defer_unsynchronized(self, now_ns: int, transmission: Transmission) -> Set[int]:
        """Start EIFS of the stations that detected a transmission with interference and were not synchronized to it.

        Returns:
            The stations that still detect another transmission, for which its end will determine EIFS.
        """
        undetermined = {index for other in self._on_air for index in other.detected_by}
        for index in transmission.detected_by:
            if (
                index not in transmission.receivers
                and index not in undetermined
                and self._stations[index].sending_until_ns < now_ns
            ):
                self._defer(now_ns, index, now_ns)
        return undetermined

    def _defer(self, now_ns: int, index: int, end_ns: int) -> None:
        """Start EIFS of a station: the inter-frame space of its queue after SIFS and an ACK at the basic rate."""
        contention = self._stations[index].contention
        self._deferring[index] = ends_ns = end_ns + self._eifs_extra_ns
        self._eifs_ends_ns = max(self._eifs_ends_ns, ends_ns)
        contention.defer_until(ends_ns + contention.ifs_ns)
        if index in self._events.starts:
            self._events.schedule_start(contention.earliest_start_ns(now_ns), index)

    def _undecoded(self, transmission: Transmission, receivers: Set[int]) -> list[int]:
        """Return the stations among `receivers`, which are synchronized to a transmission, that did not decode it."""
        results, powers_mw, noise_mw = self._results, transmission.powers_mw, self._channel.noise_mw
        undecoded = [index for index, is_decoded in results.items() if not is_decoded and index in receivers]
        uncertain: Iterable[int] = receivers
        if not transmission.interferers:
            always = always_decoded_ratio(transmission)
            if transmission.weakest_ratio >= always:
                return undecoded
            uncertain = [index for index in receivers if powers_mw[index] < always * noise_mw[index]]
        for index in uncertain:
            if index not in results:
                probability = decoding_probability(transmission, index, noise_mw[index])
                if probability < 1 and (not probability or self._draw_overheard(transmission, index) >= probability):
                    undecoded.append(index)
        return sorted(undecoded)

    def _draw_overheard(self, transmission: Transmission, index: int) -> float:
        draws = self._link_draws(transmission.transmitter, index, "overheard")
        return draws.draw(transmission.packet, transmission.attempt)

    def _use_decoded(self, now_ns: int, stations: Set[int], reserved_ns: int) -> None:
        """End EIFS of stations that decoded a frame, and reserve the channel until `reserved_ns`, unless it is 0."""
        for index in sorted(stations):
            ends_eifs = self._deferring.get(index, 0) > now_ns
            if not ends_eifs and not reserved_ns:
                continue
            contention = self._stations[index].contention
            if ends_eifs:
                del self._deferring[index]
                contention.end_eifs()
            if reserved_ns:
                contention.set_busy_until(reserved_ns)
            if index in self._events.starts:
                self._events.schedule_start(contention.earliest_start_ns(now_ns), index)

    def abort(self, index: int, now_ns: int) -> None:
        """Abort the transmission of a station, so that no station decodes it, and abort the station's reception."""
        station = self._stations[index]
        if station.receiving is not None:
            station.receiving.receivers.discard(index)
            station.receiving = None
        for transmission in self._on_air:
            if transmission.transmitter == index:
                for receiver in transmission.receivers:
                    self._stations[receiver].receiving = None
                transmission.receivers.clear()
        station.sending_until_ns = min(station.sending_until_ns, now_ns)

    def set_emissions(self, now_ns: int, emissions: Mapping[str, Emission]) -> None:
        """Set the noise on the air until the next call, by name of its source, whose received powers may change."""
        for name, emission in self._emissions.items():
            if name not in emissions:
                emission.end_ns = now_ns
        current = {name: self._emissions.get(name, emission) for name, emission in emissions.items()}
        for name, emission in current.items():
            if name not in self._emissions:
                for transmission in self._on_air:
                    transmission.interferers.append(emission)
            emission.powers_mw = emissions[name].powers_mw
        self._emissions = current

    def is_jammed(self, index: int) -> bool:
        """Return True if the noise of jammers and ovens at a station is so strong that the station does not send."""
        emissions = self._emissions.values()
        return bool(emissions) and sum(emission.powers_mw[index] for emission in emissions) >= _ENERGY_DETECTION_MW

    def decodes(self, index: int, transmission: Transmission, purpose: str) -> bool:
        """Return True if a station decodes a frame that ends now; call it once per station, before `end`.

        Args:
            index: Index of the station.
            transmission: The frame.
            purpose: Name of the stream of draws: data frames and ACKs have separate draws.
        """
        if index not in transmission.receivers:
            return False
        draw = self._link_draws(transmission.transmitter, index, purpose).draw(
            transmission.packet, transmission.attempt
        )
        is_decoded = draw < success_probability(transmission, index, self._channel.noise_mw[index])
        self._results[index] = is_decoded
        if not is_decoded:
            self._has_failed = True
        return is_decoded

    def decode_frames(
        self, index: int, transmission: Transmission, aggregate: Aggregate[Payload]
    ) -> list[Frame[Payload]]:
        """Return the frames that a station decodes of an aggregate that ends now; call it once, before `end`."""
        if index not in transmission.receivers:
            return []
        noise_mw, draws = self._channel.noise_mw[index], self._link_draws(transmission.transmitter, index, "data")
        start_ns = transmission.start_ns + transmission.mode.preamble_ns
        ns_per_byte = (transmission.end_ns - start_ns) / aggregate.size_bytes
        decoded_frames: list[Frame[Payload]] = []
        before_bytes = 0
        probabilities: dict[int, float] = {}
        has_amsdus = aggregate.frame_count < len(aggregate.frames)
        amsdus = [*frames_of(aggregate.frames)] if has_amsdus else []
        for number, frame in enumerate([packets[0] for packets in amsdus] or aggregate.frames):
            size_bytes = frame_bytes(amsdus[number]) if has_amsdus else frame.size_bytes + QOS_HEADER_BYTES
            probability = None if transmission.interferers else probabilities.get(size_bytes)
            if probability is None:
                frame_start_ns = start_ns + round(before_bytes * ns_per_byte)
                end_ns = frame_start_ns + max(round(size_bytes * ns_per_byte), 1)
                probability = probabilities[size_bytes] = part_success_probability(
                    transmission, index, noise_mw, (frame_start_ns, end_ns), 8.0 * size_bytes
                )
            before_bytes += size_bytes
            if draws.draw(frame.packet, frame.attempts) < probability:
                decoded_frames.extend(amsdus[number] if has_amsdus else (frame,))
        self._results[index] = bool(decoded_frames)
        if not decoded_frames:
            self._has_failed = True
        return decoded_frames

    def _reach(self, transmitter: int, now_ns: int) -> _Reach:
        """Return the stations that a transmitter reaches now."""
        powers_mw = self._channel.powers_mw(transmitter, now_ns)
        reach = self._reaches.get(transmitter)
        if reach is not None and reach.powers_mw is powers_mw:
            return reach
        is_detected = map(ge, powers_mw, self._channel.sensitivity_mw)
        detected_by = [index for index, is_strong in enumerate(is_detected) if is_strong and index != transmitter]
        noise_mw = self._channel.noise_mw
        ratios = map(truediv, map(powers_mw.__getitem__, detected_by), map(noise_mw.__getitem__, detected_by))
        weakest_ratio = min(ratios, default=math.inf)
        reach = self._reaches[transmitter] = _Reach(powers_mw, detected_by, weakest_ratio)
        return reach

    def _link_draws(self, transmitter: int, receiver: int, purpose: str) -> PacketDraws:
        key = transmitter, receiver, purpose
        draws = self._draws.get(key)
        if draws is None:
            names = self._channel.names
            draws = self._draws[key] = PacketDraws(self._seed, names[transmitter], names[receiver], purpose)
        return draws
