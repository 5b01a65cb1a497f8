"""Messages of the generic netlink family MAC80211_HWSIM: `drivers/net/wireless/mac80211_hwsim.h` of Linux 6.1."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NewType

from sim_backends.emulated.linux_wifi.netlink import NetlinkFormatError, decode_generic, encode_generic

FAMILY: Final = "MAC80211_HWSIM"
_VERSION: Final = 1

# Commands (HWSIM_CMD_*).
CMD_REGISTER: Final = 1
CMD_FRAME: Final = 2
CMD_TX_INFO_FRAME: Final = 3
CMD_ADD_MAC_ADDR: Final = 7
CMD_DEL_MAC_ADDR: Final = 8

# Attributes of a message (HWSIM_ATTR_*).
_RECEIVER: Final = 1
_TRANSMITTER: Final = 2
_FRAME: Final = 3
_FLAGS: Final = 4
_RX_RATE: Final = 5
_SIGNAL: Final = 6
_TX_INFO: Final = 7
_COOKIE: Final = 8
_FREQUENCY: Final = 19
_TX_INFO_FLAGS: Final = 21

# Flags of a frame (HWSIM_TX_CTL_NO_ACK, HWSIM_TX_STAT_ACK).
FLAG_NO_ACK: Final = 2
FLAG_ACKNOWLEDGED: Final = 4

# Flags of a stage of a rate chain (MAC80211_HWSIM_TX_RC_*).
RATE_MCS: Final = 1 << 3
RATE_40_MHZ: Final = 1 << 5
RATE_SHORT_GUARD_INTERVAL: Final = 1 << 7
RATE_VHT: Final = 1 << 8
RATE_80_MHZ: Final = 1 << 9
RATE_160_MHZ: Final = 1 << 10

STAGES: Final = 4
"""Number of stages of a rate chain (IEEE80211_TX_MAX_RATES): the rates that mac80211 gives a frame, one per stage."""
MIN_FRAME_BYTES: Final = 10
"""Frame control, duration and the receiver's address: the shortest frames of 802.11, 9.3.1 (without FCS)."""
MAX_FRAME_BYTES: Final = 11_454
"""Longest MPDU of 802.11ac (9.2.4.7.1): no frame of a kernel is longer."""
_MIN_CLONED_BYTES: Final = 24
"""The kernel rejects shorter frames (control frames) from a medium."""
_RETRY: Final = 0x08
"""The retry flag in the second byte of a frame."""

_RATE: Final = struct.Struct("=bB")
_RATE_FLAGS: Final = struct.Struct("=bH")

RadioAddress = NewType("RadioAddress", bytes)
"""Address that identifies a radio of hwsim: 42:00:00:00:NN:00. Interfaces use other addresses."""


@dataclass(frozen=True)
class RateStage:
    """One stage of a rate chain.

    Attributes:
        index: Index of the rate in the list of the band; with `RATE_MCS` the MCS; with `RATE_VHT` the MCS plus 16 for
            each stream after the first.
        tries: Number of tries.
        flags: `RATE_*`.
    """

    index: int
    tries: int
    flags: int = 0


@dataclass(frozen=True)
class SentFrame:
    """A frame that a radio sends.

    Attributes:
        radio: Its radio.
        frame: The frame of IEEE 802.11, without FCS.
        flags: `FLAG_NO_ACK`, and a request for the status.
        frequency_mhz: Centre frequency of the channel.
        stages: The rate chain; the tries of the first stage come first.
        cookie: Number of the frame in its radio.
    """

    radio: RadioAddress
    frame: bytes
    flags: int
    frequency_mhz: int
    stages: tuple[RateStage, ...]
    cookie: int

    @property
    def receiver(self) -> bytes:
        """Address 1, the receiver: 9.3.1 and 9.3.2.1 of IEEE 802.11-2020."""
        return self.frame[4:10]

    @property
    def transmitter(self) -> bytes | None:
        """Address 2, the transmitter; None if the frame is too short to have it (ACK, CTS)."""
        return self.frame[10:16] if len(self.frame) >= 16 else None

    @property
    def is_group(self) -> bool:
        """True for a broadcast or multicast."""
        return bool(self.receiver[0] & 1)


@dataclass(frozen=True)
class InterfaceAddress:
    """An address that was added to, or removed from, an interface of a radio.

    Attributes:
        radio: The radio.
        address: MAC address of the interface.
        is_added: False if the address was removed.
    """

    radio: RadioAddress
    address: bytes
    is_added: bool


def decode_event(payload: bytes) -> SentFrame | InterfaceAddress | None:
    """Return the event of a message from the kernel; None if it is of another kind.

    Raises:
        NetlinkFormatError: The message is malformed, or a value is outside of its limits.
    """
    command, attributes = decode_generic(payload)
    if command == CMD_FRAME:
        return _sent_frame(attributes)
    if command in {CMD_ADD_MAC_ADDR, CMD_DEL_MAC_ADDR}:
        radio = RadioAddress(_value(attributes, _TRANSMITTER, 6))
        return InterfaceAddress(radio, _value(attributes, _RECEIVER, 6), command == CMD_ADD_MAC_ADDR)
    return None


def encode_register() -> bytes:
    """Return the message that makes its sender the medium of all radios created in its network namespace."""
    return encode_generic(CMD_REGISTER, _VERSION, {})


def encode_status(frame: SentFrame, *, tries: Sequence[int], acknowledged: bool, signal_dbm: int) -> bytes:
    """Return the report on a sent frame.

    Args:
        frame: The frame.
        tries: Number of tries made in each stage of its chain, from the first; the last one succeeded if
            `acknowledged`.
        acknowledged: True if an ACK arrived.
        signal_dbm: Signal of the ACK.
    """
    rates = b""
    for number in range(STAGES):
        is_tried = number < min(len(tries), len(frame.stages))
        rates += _RATE.pack(frame.stages[number].index, tries[number]) if is_tried else _RATE.pack(-1, 0)
    flags = frame.flags | (FLAG_ACKNOWLEDGED if acknowledged else 0)
    return encode_generic(
        CMD_TX_INFO_FRAME,
        _VERSION,
        {
            _TRANSMITTER: frame.radio,
            _FLAGS: struct.pack("=I", flags),
            _SIGNAL: struct.pack("=i", signal_dbm),
            _TX_INFO: rates,
            _COOKIE: struct.pack("=Q", frame.cookie),
        },
    )


def encode_reception(
    frame: SentFrame, receiver: RadioAddress, *, rate_index: int, signal_dbm: int, is_retry: bool = False
) -> bytes | None:
    """Return the message that passes a frame to a receiving radio; None if the frame is too short for the kernel.

    Args:
        frame: The frame.
        receiver: The radio.
        rate_index: Index of the rate in the list of the band; the message has no field for an MCS.
        signal_dbm: Received signal.
        is_retry: True if it was not the first try. Then the message has the retry flag (9.2.4.1.6), which a radio
            sets in hardware. Encryption does not protect this flag (12.5.3.3.3).
    """
    if len(frame.frame) < _MIN_CLONED_BYTES:
        return None
    flags = frame.frame[1] | (_RETRY if is_retry else 0)
    return encode_generic(
        CMD_FRAME,
        _VERSION,
        {
            _RECEIVER: receiver,
            _FRAME: frame.frame[:1] + bytes((flags,)) + frame.frame[2:],
            _RX_RATE: struct.pack("=I", rate_index),
            _SIGNAL: struct.pack("=i", signal_dbm),
            _FREQUENCY: struct.pack("=I", frame.frequency_mhz),
        },
    )


def encode_sent(frame: SentFrame) -> bytes:
    """Return the message of the kernel for a frame that a radio sends, for tests and recordings."""
    stages = [*frame.stages, *[RateStage(-1, 0)] * (STAGES - len(frame.stages))]
    return encode_generic(
        CMD_FRAME,
        _VERSION,
        {
            _TRANSMITTER: frame.radio,
            _FRAME: frame.frame,
            _FLAGS: struct.pack("=I", frame.flags),
            _FREQUENCY: struct.pack("=I", frame.frequency_mhz),
            _TX_INFO: b"".join(_RATE.pack(stage.index, stage.tries) for stage in stages),
            _TX_INFO_FLAGS: b"".join(_RATE_FLAGS.pack(stage.index, stage.flags) for stage in stages),
            _COOKIE: struct.pack("=Q", frame.cookie),
        },
    )


def _sent_frame(attributes: dict[int, bytes]) -> SentFrame:
    frame = attributes.get(_FRAME, b"")
    if not MIN_FRAME_BYTES <= len(frame) <= MAX_FRAME_BYTES:
        raise NetlinkFormatError(f"a frame has {len(frame)} bytes, not {MIN_FRAME_BYTES} to {MAX_FRAME_BYTES}")
    return SentFrame(
        radio=RadioAddress(_value(attributes, _TRANSMITTER, 6)),
        frame=frame,
        flags=_number("=I", _value(attributes, _FLAGS, 4)),
        frequency_mhz=_number("=I", _value(attributes, _FREQUENCY, 4)),
        stages=_stages(_value(attributes, _TX_INFO, STAGES * _RATE.size), attributes.get(_TX_INFO_FLAGS, b"")),
        cookie=_number("=Q", _value(attributes, _COOKIE, 8)),
    )


def _stages(rates: bytes, flags: bytes) -> tuple[RateStage, ...]:
    """Return the stages of a rate chain from the attributes TX_INFO and TX_INFO_FLAGS."""
    stages = []
    # The flags have the same order; old kernels do not send them.
    all_flags = (
        [bits for _, bits in _RATE_FLAGS.iter_unpack(flags)] if len(flags) == STAGES * _RATE_FLAGS.size else []
    )
    for number, (index, tries) in enumerate(_RATE.iter_unpack(rates)):
        if index < 0:
            break
        stages.append(RateStage(index, tries, all_flags[number] if all_flags else 0))
    return tuple(stages)


def _value(attributes: dict[int, bytes], kind: int, size: int) -> bytes:
    value = attributes.get(kind, b"")
    if len(value) != size:
        raise NetlinkFormatError(f"attribute {kind} has {len(value)} bytes, not {size}")
    return value


def _number(layout: str, value: bytes) -> int:
    return int(struct.unpack(layout, value)[0])
