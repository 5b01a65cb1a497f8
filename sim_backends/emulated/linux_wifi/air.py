"""The air between radios of Linux: the radio model decides whether each try of a frame succeeds.

Every channel in use has a separate radio model, because frames on different channels do not interfere. The driver of
the radios (mac80211_hwsim) does not report the channel to which a radio listens. A radio is therefore assumed to be
on the channel of its last frame, and on all channels before its first frame. On all channels the radio model uses the
path loss of 2.4 GHz.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from typing_extensions import override

from fieldkit.core.model import Vector
from sim_backends.emulated.linux_wifi.hwsim_messages import FLAG_NO_ACK, SentFrame
from sim_backends.emulated.linux_wifi.rate_chain import RateChain, rate_chain
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.core.links import QUEUE_FULL, RADIO_OFF
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.mac.frames import HEADER_BYTES, TransmissionAttempt
from sim_backends.radio.phy.modes import G_MODES, SHORT_RETRY_LIMIT, WifiMode
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.rate_control.rate_control import RateControl
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.motion import Attitude
from sim_backends.world.world import World

_FCS_BYTES: Final = 4
"""Length of the frame check sequence, which frames from the kernel do not contain."""
_LOWEST_SIGNAL_DBM: Final = -120
_ABSENT: Final = ""
"""Station without a position: the receiver of frames to an address that no radio has."""


@dataclass(eq=False)
class FrameOnAir:
    """A frame, from its transmission until its status is reported.

    Attributes:
        sent_frame: The frame.
        source: Name of its transmitter.
        receiver: Name of its receiver; None for a broadcast or multicast, `""` if no other radio has the address.
        chain: Its tries; a broadcast or multicast has one, at 6 Mbit/s.
        attempts: Number of tries that have started.
        is_acknowledged: True if an ACK was received.
        signal_dbm: Signal of that ACK, at the start of the try; -120 without an ACK.
        mode: Mode of the first try that a receiver decoded; the lowest mode of 802.11g if there is none.
        decoded_try: Number of that try, from 1; 0 if no receiver has decoded the frame.
        is_final: True if its status is known.
    """

    sent_frame: SentFrame
    source: str
    receiver: str | None
    chain: RateChain
    attempts: int = 0
    is_acknowledged: bool = False
    signal_dbm: int = _LOWEST_SIGNAL_DBM
    mode: WifiMode = G_MODES[0]
    decoded_try: int = 0
    is_final: bool = False


@dataclass(frozen=True)
class FrameReception:
    """A frame that arrived at a radio.

    Attributes:
        receiver: Name of the radio.
        frame: The frame.
        mode: Mode in which it was decoded.
        signal_dbm: Received signal.
    """

    receiver: str
    frame: FrameOnAir
    mode: WifiMode
    signal_dbm: int


@dataclass
class AirEvents:
    """Events on the air since the last call of `Air.pop_events`.

    Attributes:
        receptions: Frames that arrived, in order on each channel.
        statuses: Frames whose status became known, in order on each channel.
    """

    receptions: list[FrameReception] = field(default_factory=list)
    statuses: list[FrameOnAir] = field(default_factory=list)


class _ChainRates(RateControl):
    """Rate control of one link: the modes of the chain that mac80211 gave to each frame. Frames are sent in order."""

    def __init__(self, channel: "_Channel", transmitter: int, receiver: int) -> None:
        self._channel = channel
        self._ends = transmitter, receiver
        self._frame: FrameOnAir | None = None
        self._now_ns = 0

    @override
    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
        self._frame, self._now_ns = self._channel.frames[packet], now_ns
        self._frame.attempts = attempt
        return self._frame.chain.modes[attempt - 1]

    @override
    def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:
        frame = self._frame
        assert frame is not None
        frame.is_acknowledged = bool(acknowledged)
        if acknowledged:
            transmitter, receiver = self._ends
            frame.signal_dbm = self._channel.signal_dbm(receiver, transmitter, self._now_ns)
        if acknowledged or frame.attempts == len(frame.chain.modes):
            self._channel.finish(frame)


class _ChannelLinks(WorldChannel):
    """The links on one channel, with the rate chains of mac80211.

    All stations count as associated: mac80211 decides about associations, and its frames need airtime even if the
    receiver is out of range.
    """

    channel: "_Channel"

    @override
    def are_linked(self, transmitter: int, receiver: int) -> bool:
        return True

    @override
    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        return _ChainRates(self.channel, transmitter, receiver)


class _Channel:
    """The radio model of one channel.

    Args:
        seed: Seed of all random draws.
        options: Radio options.
        antennas: The radios, by name.
        world: Obstacles; None for open ground.

    Attributes:
        frames: Frames whose status is not known, by identity.
        events: Events since the last call of `pop_events`.
    """

    def __init__(
        self, seed: int, options: RadioOptions, antennas: Mapping[str, Antenna], world: World | None
    ) -> None:
        self._links = _ChannelLinks(seed, {**antennas, _ABSENT: next(iter(antennas.values()))}, options, world)
        self._links.channel = self
        self._index = {name: index for index, name in enumerate(self._links.names)}
        self._wifi: Wifi[FrameOnAir] = Wifi(self._links, seed, queue_packets=options.queue_packets)
        self._wifi.log_attempts(self._on_attempt)
        self._wifi.log_losses(self._on_loss)
        self._numbers = dict.fromkeys(antennas, 0)
        self._identities: dict[FrameOnAir, PacketIdentity] = {}
        self.frames: dict[PacketIdentity, FrameOnAir] = {}
        self.events = AirEvents()

    def place(
        self,
        now_ns: int,
        positions_m: Mapping[str, Vector],
        velocities_m_s: Mapping[str, Vector],
        attitudes: Mapping[str, Attitude],
    ) -> None:
        self._wifi.advance(now_ns)
        self._links.move(now_ns, positions_m, velocities_m_s, attitudes)

    def transmit(self, now_ns: int, frame: FrameOnAir) -> None:
        """Send a frame. If its chain has no try on the air, its status is reported immediately."""
        number = self._numbers[frame.source]
        self._numbers[frame.source] = number + 1
        identity = frame.source, number
        self.frames[identity], self._identities[frame] = frame, identity
        tries = len(frame.chain.modes)
        if not tries:
            self.finish(frame)
            return
        size_bytes = len(frame.sent_frame.frame) + _FCS_BYTES - HEADER_BYTES
        self._wifi.send(now_ns, frame.source, frame, size_bytes, frame.receiver, packet=identity, max_attempts=tries)

    def next_event_ns(self) -> int | None:
        return self._wifi.next_event_ns()

    def pop_events(self, now_ns: int) -> AirEvents:
        for at_ns, name, frame, source, _ in self._wifi.deliveries(now_ns):
            signal_dbm = self.signal_dbm(self._index[source], self._index[name], at_ns)
            self.events.receptions.append(FrameReception(name, frame, frame.mode, signal_dbm))
        events, self.events = self.events, AirEvents()
        return events

    def signal_dbm(self, transmitter: int, receiver: int, now_ns: int) -> int:
        power_mw = self._links.powers_mw(transmitter, now_ns)[receiver]
        return max(_LOWEST_SIGNAL_DBM, round(decibel(power_mw)))

    def finish(self, frame: FrameOnAir) -> None:
        """Report the status of a frame; a second call has no effect."""
        if not frame.is_final:
            frame.is_final = True
            del self.frames[self._identities.pop(frame)]
            self.events.statuses.append(frame)

    def _on_attempt(self, attempt: TransmissionAttempt) -> None:
        """Store mode and number of the first decoded try. The status of a broadcast is known after its only try."""
        frame = attempt.payload
        if not isinstance(frame, FrameOnAir):
            return  # an ACK
        if attempt.received and not frame.decoded_try:
            frame.mode, frame.decoded_try = attempt.mode, attempt.number
        if attempt.receiver is None:
            frame.attempts = 1
            self.finish(frame)

    def _on_loss(self, now_ns: int, frame: FrameOnAir, receiver: str, reason: str) -> None:  # noqa: ARG002 (LossLog)
        if reason in {QUEUE_FULL, RADIO_OFF}:
            self.finish(frame)


class Air:
    """The air between radios on any number of channels.

    Args:
        seed: Seed of all random draws.
        options: Radio options; `mode` has no effect, because mac80211 selects the rates.
        antennas: The radios, by name.
        world: Obstacles; None for open ground.

    Raises:
        ValueError: There is no radio, or the name of a radio is empty.
    """

    def __init__(
        self, seed: int, options: RadioOptions, antennas: Mapping[str, Antenna], world: World | None = None
    ) -> None:
        if not antennas or _ABSENT in antennas:
            raise ValueError("the air needs at least one radio, each with a name")
        self._channel_arguments = seed, options.model_copy(update={"mode": None}), antennas, world
        self._channels: dict[int, _Channel] = {}
        # Channel of the last frame of each radio.
        self._tuned_mhz: dict[str, int] = {}
        self._positions_m: Mapping[str, Vector] = {}
        self._velocities_m_s: Mapping[str, Vector] = {}
        self._attitudes: Mapping[str, Attitude] = {}

    def place(
        self,
        now_ns: int,
        positions_m: Mapping[str, Vector],
        velocities_m_s: Mapping[str, Vector] | None = None,
        attitudes: Mapping[str, Attitude] | None = None,
    ) -> None:
        """Set the state of the radios, which is valid until the next call.

        Args:
            now_ns: Current time.
            positions_m: Metres east, north, up; radios without a position are out of range.
            velocities_m_s: Metres per second east, north, up; 0 for radios that are not named.
            attitudes: Attitudes; the other radios keep theirs.
        """
        self._positions_m, self._velocities_m_s = dict(positions_m), dict(velocities_m_s or {})
        self._attitudes = {**self._attitudes, **(attitudes or {})}
        for frequency_mhz in self._channels:
            self._place(now_ns, frequency_mhz)

    def transmit(self, now_ns: int, sent_frame: SentFrame, source: str, receiver: str | None) -> None:
        """Send a frame at `now_ns`; times must not decrease.

        Args:
            now_ns: Current time.
            sent_frame: The frame.
            source: Name of its radio.
            receiver: Name of the radio with the receiver's address; None if no radio has it. Ignored for a broadcast
                or multicast.
        """
        frequency_mhz = sent_frame.frequency_mhz
        if frequency_mhz not in self._channels:
            self._channels[frequency_mhz] = _Channel(*self._channel_arguments)
            self._place(now_ns, frequency_mhz)
        previous_mhz = self._tuned_mhz.get(source)
        if previous_mhz != frequency_mhz:
            self._tuned_mhz[source] = frequency_mhz
            changed_mhz = self._channels if previous_mhz is None else (previous_mhz, frequency_mhz)
            for channel_mhz in changed_mhz:
                self._place(now_ns, channel_mhz)
        destination: str | None
        if sent_frame.is_group:
            destination, chain = None, rate_chain((), frequency_mhz)
        else:
            destination = _ABSENT if receiver is None or receiver == source else receiver
            max_tries = 1 if sent_frame.flags & FLAG_NO_ACK else SHORT_RETRY_LIMIT
            chain = rate_chain(sent_frame.stages, frequency_mhz, max_tries=max_tries)
        self._channels[frequency_mhz].transmit(now_ns, FrameOnAir(sent_frame, source, destination, chain))

    def next_event_ns(self) -> int | None:
        """Return the time of the next event, or None if there is no frame on the air."""
        times = [at_ns for channel in self._channels.values() if (at_ns := channel.next_event_ns()) is not None]
        return min(times, default=None)

    def pop_events(self, now_ns: int) -> AirEvents:
        """Return the events up to `now_ns` that were not returned before; receptions of a channel are in order."""
        events = AirEvents()
        for channel in self._channels.values():
            new_events = channel.pop_events(now_ns)
            events.receptions += new_events.receptions
            events.statuses += new_events.statuses
        return events

    def _place(self, now_ns: int, frequency_mhz: int) -> None:
        """Place the radios that are on a channel, or may be on it."""
        positions_m = {
            name: position_m
            for name, position_m in self._positions_m.items()
            if self._tuned_mhz.get(name, frequency_mhz) == frequency_mhz
        }
        velocities_m_s = {name: velocity for name, velocity in self._velocities_m_s.items() if name in positions_m}
        self._channels[frequency_mhz].place(now_ns, positions_m, velocities_m_s, self._attitudes)
