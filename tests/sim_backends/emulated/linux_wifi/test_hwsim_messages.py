"""Messages of hwsim: bytes computed by hand from the kernel's header, and malformed messages."""

import struct
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.linux_wifi.hwsim_messages import (
    CMD_ADD_MAC_ADDR,
    CMD_FRAME,
    FLAG_NO_ACK,
    InterfaceAddress,
    RadioAddress,
    RateStage,
    SentFrame,
    decode_event,
    encode_reception,
    encode_register,
    encode_sent,
    encode_status,
)
from sim_backends.emulated.linux_wifi.netlink import NetlinkFormatError, decode_generic, encode_generic

pytestmark = pytest.mark.skipif(sys.byteorder != "little", reason="the bytes are those of a little-endian host")

RADIO = RadioAddress(bytes.fromhex("420000000100"))
# A data frame from 02:..:01:00 to 02:..:00:00.
FRAME = bytes.fromhex("0801 0000 020000000000 020000000100 020000000000 1000") + b"data"
SENT = SentFrame(RADIO, FRAME, 1, 2437, (RateStage(7, 2, 8), RateStage(0, 3)), 0x1122334455667788)


def test_registering_is_a_command_without_attributes() -> None:
    assert encode_register() == bytes.fromhex("01 01 0000")


def test_a_status_has_the_bytes_computed_by_hand() -> None:
    expected = bytes.fromhex(
        "03 01 0000"
        " 0a00 0200 420000000100 0000"  # transmitter, padded
        " 0800 0400 05000000"  # flags: status requested, acknowledged
        " 0800 0600 c7ffffff"  # -57 dBm
        " 0c00 0700 0702 0001 ff00 ff00"  # rate 7 twice, rate 0 once, unused
        " 0c00 0800 8877665544332211"  # cookie
    )
    assert encode_status(SENT, tries=[2, 1], acknowledged=True, signal_dbm=-57) == expected


def test_a_received_frame_has_the_bytes_computed_by_hand() -> None:
    expected = (
        bytes.fromhex("02 01 0000  0a00 0100 420000000000 0000  2000 0300")
        + FRAME
        + bytes.fromhex("0800 0500 0b000000  0800 0600 b0ffffff  0800 1300 85090000")
    )
    receiver = RadioAddress(bytes.fromhex("420000000000"))
    assert encode_reception(SENT, receiver, rate_index=11, signal_dbm=-80) == expected
    retried_frame = SENT.frame[:1] + bytes((SENT.frame[1] | 0x08,)) + SENT.frame[2:]
    assert encode_reception(SENT, receiver, rate_index=11, signal_dbm=-80, is_retry=True) == expected.replace(
        SENT.frame, retried_frame
    )


def test_a_control_frame_is_not_passed_on_because_the_kernel_rejects_it() -> None:
    acknowledgement = SentFrame(RADIO, FRAME[:10], 0, 2437, (), 1)
    assert acknowledgement.transmitter is None
    assert encode_reception(acknowledgement, RADIO, rate_index=0, signal_dbm=-50) is None


def test_a_sent_frame_is_decoded_with_its_rate_chain() -> None:
    event = decode_event(encode_sent(SENT))
    assert event == SENT
    assert isinstance(event, SentFrame)
    assert (event.receiver.hex(), (event.transmitter or b"").hex()) == ("020000000000", "020000000100")
    assert not event.is_group


def test_a_frame_without_rate_flags_is_decoded() -> None:
    _, attributes = decode_generic(encode_sent(SENT))
    del attributes[21]
    event = decode_event(encode_generic(CMD_FRAME, 1, attributes))
    assert isinstance(event, SentFrame)
    assert event.stages == (RateStage(7, 2), RateStage(0, 3))


def test_the_address_of_an_interface_is_the_attribute_receiver() -> None:
    interface = bytes.fromhex("020000000100")
    event = decode_event(encode_generic(CMD_ADD_MAC_ADDR, 1, {1: interface, 2: RADIO}))
    assert event == InterfaceAddress(RADIO, interface, is_added=True)


def test_other_commands_are_not_events() -> None:
    assert decode_event(encode_generic(4, 1, {})) is None


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (2, b"short"),
        (3, bytes(9)),
        (3, bytes(12_000)),
        (4, b""),
        (7, bytes(6)),
        (8, struct.pack("=I", 1)),
        (19, b"\x01"),
    ],
)
def test_a_frame_with_a_value_of_wrong_size_is_rejected(kind: int, value: bytes) -> None:
    _, attributes = decode_generic(encode_sent(SENT))
    with pytest.raises(NetlinkFormatError):
        decode_event(encode_generic(CMD_FRAME, 1, {**attributes, kind: value}))


@given(st.integers(0, 9), st.dictionaries(st.integers(0, 30), st.binary(max_size=40)))
def test_any_attributes_are_an_event_or_rejected(command: int, attributes: dict[int, bytes]) -> None:
    try:
        event = decode_event(encode_generic(command, 1, attributes))
    except NetlinkFormatError:
        return
    assert event is None or len(event.radio) == 6


def test_a_report_never_has_more_stages_than_the_chain() -> None:
    without_chain = SentFrame(RADIO, FRAME, FLAG_NO_ACK, 2437, (), 5)
    status = encode_status(without_chain, tries=[1], acknowledged=False, signal_dbm=-120)
    assert decode_generic(status)[1][7] == bytes.fromhex("ff00") * 4
