"""The medium of mac80211_hwsim, which passes frames from the kernel to the air, and results to the kernel.

`HwsimMedium` has no socket: it maps messages to messages, so tests can use recorded messages. `medium_program` runs
it.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from sim_backends.emulated.linux_wifi.air import Air, FrameOnAir, FrameReception
from sim_backends.emulated.linux_wifi.hwsim_messages import (
    InterfaceAddress,
    RadioAddress,
    SentFrame,
    decode_event,
    encode_reception,
    encode_status,
)
from sim_backends.emulated.linux_wifi.netlink import NLMSG_ERROR, NetlinkFormatError, NetlinkMessage
from sim_backends.emulated.linux_wifi.rate_chain import legacy_index
from sim_backends.radio.core.links import Pair

MAX_FREQUENCY_MHZ: Final = 7_125
MIN_FREQUENCY_MHZ: Final = 2_412
"""Limits of the bands of Wi-Fi, from channel 1 at 2.4 GHz to the end of the 6 GHz band."""
_MAX_ADDRESSES: Final = 64
"""Maximum number of addresses of a radio, because a robot can change the address of its interface at any time."""
_RADIO_BIT: Final = 0x40
"""Bit in the first byte by which the address that identifies a radio differs from the address of its interface."""


@dataclass
class LinkTotals:
    """Totals of the unicast frames on one directed link, for comparison with `iw station dump`.

    Attributes:
        frames: Frames whose status was reported.
        acknowledged: Frames that were acknowledged.
        tries: Tries on the air.
        reported_tries: Tries reported to the kernel, including tries in modes that the radio model does not have.
            `tx retries` of `iw` is this number minus `frames`.
        signal_dbm: Signal of the last frame that arrived, unicast or not; None before the first.
    """

    frames: int = 0
    acknowledged: int = 0
    tries: int = 0
    reported_tries: int = 0
    signal_dbm: int | None = None


@dataclass
class MediumCounts:
    """Counts of messages.

    Attributes:
        rejected_messages: Messages that were malformed, or from a radio that is not part of the lab.
        errors: Errors that the kernel returned, by number; EINVAL includes frames to a radio on another channel.
    """

    rejected_messages: int = 0
    errors: Counter[int] = field(default_factory=Counter)


class HwsimMedium:
    """Passes the frames of all radios through the air, and reports the results to the kernel.

    Args:
        air: The air.
        radios: Name of each radio in the air, by its address.

    Attributes:
        air: The air.
        counts: Counts of messages.
        totals: Totals of each directed link.
    """

    def __init__(self, air: Air, radios: Mapping[RadioAddress, str]) -> None:
        self.air = air
        self.counts = MediumCounts()
        self.totals: dict[Pair, LinkTotals] = {}
        self._name_of_radio = dict(radios)
        self._radio_of_name = {name: radio for radio, name in radios.items()}
        # The address of a radio's first interface differs in one bit from the address that identifies the radio.
        self._name_of_interface = {
            bytes((radio[0] & ~_RADIO_BIT,)) + radio[1:]: name for radio, name in self._name_of_radio.items()
        }
        self._address_counts = Counter(self._name_of_interface.values())

    def receive(self, now_ns: int, message: NetlinkMessage) -> None:
        """Accept a message from the kernel at `now_ns`. Malformed messages are counted and ignored."""
        try:
            if message.type == NLMSG_ERROR:
                self.counts.errors[message.error_number] += 1
                return
            event = decode_event(message.payload)
        except NetlinkFormatError:
            self.counts.rejected_messages += 1
            return
        match event:
            case SentFrame():
                self._transmit(now_ns, event)
            case InterfaceAddress():
                self._update_address(event)

    def replies(self, now_ns: int) -> list[bytes]:
        """Return the messages for the kernel that are due at `now_ns`: received frames, then reports on sent ones."""
        events = self.air.pop_events(now_ns)
        messages = [self._reception_message(reception) for reception in events.receptions]
        messages += [self._status_message(frame) for frame in events.statuses]
        return [message for message in messages if message is not None]

    def _transmit(self, now_ns: int, sent_frame: SentFrame) -> None:
        """Pass a frame to the air, and store the address of its transmitter."""
        name = self._name_of_radio.get(sent_frame.radio)
        if name is None or not MIN_FREQUENCY_MHZ <= sent_frame.frequency_mhz <= MAX_FREQUENCY_MHZ:
            self.counts.rejected_messages += 1
            return
        address = sent_frame.transmitter
        # An interface that existed before the medium started was not announced. An address that already belongs to a
        # radio is not reassigned.
        if address is not None and not address[0] & 1 and address not in self._name_of_interface:
            self._add_address(address, name)
        self.air.transmit(now_ns, sent_frame, name, self._name_of_interface.get(sent_frame.receiver))

    def _update_address(self, event: InterfaceAddress) -> None:
        """Add or remove an address that the kernel has announced."""
        name = self._name_of_radio.get(event.radio)
        if name is None:
            self.counts.rejected_messages += 1
        elif event.is_added:
            self._remove_address(event.address)
            self._add_address(event.address, name)
        elif self._name_of_interface.get(event.address) == name:
            self._remove_address(event.address)

    def _add_address(self, address: bytes, name: str) -> None:
        if self._address_counts[name] < _MAX_ADDRESSES:
            self._name_of_interface[address] = name
            self._address_counts[name] += 1

    def _remove_address(self, address: bytes) -> None:
        name = self._name_of_interface.pop(address, None)
        if name is not None:
            self._address_counts[name] -= 1

    def _reception_message(self, reception: FrameReception) -> bytes | None:
        frame = reception.frame
        self._totals(frame.source, reception.receiver).signal_dbm = reception.signal_dbm
        rate_index = legacy_index(reception.mode, frame.sent_frame.frequency_mhz)
        radio = self._radio_of_name[reception.receiver]
        return encode_reception(
            frame.sent_frame,
            radio,
            rate_index=rate_index,
            signal_dbm=reception.signal_dbm,
            is_retry=frame.decoded_try > 1,
        )

    def _status_message(self, frame: FrameOnAir) -> bytes:
        """Return the report on a frame for its sender, and add the frame to the totals."""
        tries = frame.chain.tries_made(frame.attempts)
        if frame.receiver:
            totals = self._totals(frame.source, frame.receiver)
            totals.frames += 1
            totals.acknowledged += frame.is_acknowledged
            totals.tries += frame.attempts
            totals.reported_tries += sum(tries)
        return encode_status(
            frame.sent_frame, tries=tries, acknowledged=frame.is_acknowledged, signal_dbm=frame.signal_dbm
        )

    def _totals(self, transmitter: str, receiver: str) -> LinkTotals:
        return self.totals.setdefault((transmitter, receiver), LinkTotals())
