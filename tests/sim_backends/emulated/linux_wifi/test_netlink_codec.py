"""Netlink messages: bytes computed by hand, any bytes, and the kernel's own controller family."""

import sys
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi.netlink import (
    NLMSG_ERROR,
    FamilySocket,
    NetlinkFormatError,
    NetlinkMessage,
    decode_generic,
    decode_messages,
    encode_generic,
    family_identifier,
    family_request,
)

pytestmark = pytest.mark.skipif(sys.byteorder != "little", reason="the bytes are those of a little-endian host")

# Length 36, type 0x10 (controller), flags REQUEST, sequence 0, port 0; command 3, version 1, reserved; an attribute
# of length 4 + 9 and type 2 with "MAC80211\0", and three bytes of padding.
FAMILY_REQUEST = bytes.fromhex(
    "24000000 1000 0100 00000000 00000000  03 01 0000  0d00 0200 4d4143383032313100 000000"
)


def test_a_request_for_a_family_has_the_bytes_computed_by_hand() -> None:
    assert family_request("MAC80211").encode() == FAMILY_REQUEST


def test_messages_of_one_datagram_are_separated() -> None:
    first = NetlinkMessage(0x1C, 0, 7, b"abcde")
    second = NetlinkMessage(NLMSG_ERROR, 0, 8, bytes.fromhex("eaffffff"))
    messages = list(decode_messages(first.encode() + second.encode()))
    assert messages == [first, second]
    assert messages[1].error_number == 22  # EINVAL


@given(
    st.integers(0, 255),
    st.dictionaries(st.integers(0, 0x3FFF), st.binary(max_size=70), max_size=8),
    st.integers(0, 0xFFFF),
)
def test_an_encoded_message_is_decoded_without_change(
    command: int, attributes: dict[int, bytes], message_type: int
) -> None:
    message = NetlinkMessage(message_type, 1, 2, encode_generic(command, 1, attributes))
    (decoded_message,) = decode_messages(message.encode())
    # The padding of the last attribute is part of the payload.
    assert decoded_message == message
    assert decode_generic(decoded_message.payload) == (command, attributes)


@given(st.binary(max_size=80))
def test_any_bytes_are_decoded_or_rejected(data: bytes) -> None:
    """Lengths of 0 or beyond the end must not loop, read further, or raise another error."""
    for decode in (lambda: list(decode_messages(data)), lambda: decode_generic(data)):
        with suppress(NetlinkFormatError):
            decode()


@pytest.mark.parametrize(
    "invalid_message",
    [
        FAMILY_REQUEST[:10],
        b"\x0f" + FAMILY_REQUEST[1:],  # shorter than its header
        b"\x25" + FAMILY_REQUEST[1:],  # longer than the datagram
    ],
)
def test_a_wrong_length_of_a_message_is_rejected(invalid_message: bytes) -> None:
    with pytest.raises(NetlinkFormatError):
        list(decode_messages(invalid_message))


@pytest.mark.parametrize("size", [0, 15, 17])
def test_a_message_shorter_than_its_header_is_rejected_and_does_not_repeat(size: int) -> None:
    with pytest.raises(NetlinkFormatError):
        next(decode_messages(size.to_bytes(4, "little") + bytes(12)))


@pytest.mark.parametrize("length", [0, 3, 14, 0xFFFF])
def test_a_wrong_length_of_an_attribute_is_rejected(length: int) -> None:
    payload = FAMILY_REQUEST[16:20] + length.to_bytes(2, "little") + FAMILY_REQUEST[22:33]
    assert len(payload) == 17
    with pytest.raises(NetlinkFormatError):
        decode_generic(payload)


def test_a_value_that_no_attribute_can_hold_is_rejected() -> None:
    with pytest.raises(NetlinkFormatError):
        encode_generic(1, 1, {1: bytes(0xFFFF)})


def test_the_kernel_answers_the_request_for_its_controller() -> None:
    """The reply is that of the running kernel: its identifier of the family `nlctrl` is fixed."""
    kernel = FamilySocket("nlctrl")
    try:
        kernel.send(family_request("nlctrl").payload)
        replies: list[NetlinkMessage] = []
        while not replies:
            replies = kernel.receive()
        assert family_identifier("nlctrl", replies[0]) == 0x10
    finally:
        kernel.close()


def test_a_family_that_the_kernel_does_not_have_is_reported_with_a_remedy() -> None:
    with pytest.raises(ConfigurationError, match="family no_such_family"):
        FamilySocket("no_such_family")
