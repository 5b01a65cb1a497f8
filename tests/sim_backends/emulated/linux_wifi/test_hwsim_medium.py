"""The medium without a kernel: the replies to messages of hwsim."""

import struct
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.linux_wifi.air import Air
from sim_backends.emulated.linux_wifi.hwsim_medium import HwsimMedium
from sim_backends.emulated.linux_wifi.hwsim_messages import (
    CMD_ADD_MAC_ADDR,
    CMD_DEL_MAC_ADDR,
    CMD_FRAME,
    CMD_TX_INFO_FRAME,
    FLAG_ACKNOWLEDGED,
    RadioAddress,
    RateStage,
    SentFrame,
    decode_event,
    encode_sent,
)
from sim_backends.emulated.linux_wifi.netlink import (
    NLMSG_ERROR,
    NetlinkMessage,
    decode_generic,
    decode_messages,
    encode_generic,
)
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.radio_options import RadioOptions
from tests.helpers.paths import ROOT

NAMES = "abc"
START_NS = 10_000_000


def radio(number: int) -> RadioAddress:
    return RadioAddress(bytes((0x42, 0, 0, 0, number, 0)))


def interface(number: int) -> bytes:
    """Return the permanent address of the first interface of a radio."""
    return bytes((0x02, 0, 0, 0, number, 0))


def new_medium() -> HwsimMedium:
    air = Air(1, RadioOptions(fading=False), dict.fromkeys(NAMES, Antenna("802.11n", 15.0, -95.0)))
    air.place(0, {name: (3.0 * number, 0.0, 1.0) for number, name in enumerate(NAMES)})
    return HwsimMedium(air, {radio(number): name for number, name in enumerate(NAMES)})


def message(payload: bytes) -> NetlinkMessage:
    return NetlinkMessage(0x1C, 0, 0, payload)


def frame_message(
    source: int, receiver: bytes, *, transmitter: bytes | None = None, cookie: int = 1
) -> NetlinkMessage:
    content = b"\x08\x01\x00\x00" + receiver + (transmitter or interface(source)) + bytes(100)
    stages = (RateStage(11, 3),)
    return message(encode_sent(SentFrame(radio(source), content, 1, 2437, stages, cookie)))


def replies_until_idle(medium: HwsimMedium, now_ns: int = START_NS) -> Iterator[tuple[int, dict[int, bytes]]]:
    """Yield all replies until no frame is on the air."""
    yield from map(decode_generic, medium.replies(now_ns))
    while (next_ns := medium.air.next_event_ns()) is not None:
        yield from map(decode_generic, medium.replies(next_ns))


def receivers_of_frame(medium: HwsimMedium) -> tuple[list[bytes], bool]:
    """Return the radios that received the frame on the air, and True if it was acknowledged."""
    radios, is_acknowledged = [], False
    for command, attributes in replies_until_idle(medium):
        if command == CMD_FRAME:
            radios.append(attributes[1])
        else:
            assert command == CMD_TX_INFO_FRAME
            is_acknowledged = bool(struct.unpack("=I", attributes[4])[0] & FLAG_ACKNOWLEDGED)
    return radios, is_acknowledged


def test_a_frame_is_passed_to_its_receiver_before_it_is_acknowledged() -> None:
    medium = new_medium()
    medium.receive(START_NS, frame_message(0, interface(1), cookie=77))
    # Both are due if the process was late.
    replies = medium.replies(START_NS + 1_000_000_000)
    (frame_command, frame), (status_command, status) = map(decode_generic, replies)
    assert (frame_command, status_command) == (CMD_FRAME, CMD_TX_INFO_FRAME)
    assert frame[1] == radio(1)
    assert frame[3][4:16] == interface(1) + interface(0)
    assert (status[2], struct.unpack("=Q", status[8])) == (radio(0), (77,))
    assert status[7] == bytes.fromhex("0b01 ff00 ff00 ff00")
    signal_dbm = struct.unpack("=i", frame[6])[0]
    totals = medium.totals["a", "b"]
    assert (totals.frames, totals.acknowledged, totals.tries, totals.signal_dbm) == (1, 1, 1, signal_dbm)
    assert -60 < signal_dbm < -30


def test_an_address_that_no_radio_has_is_not_acknowledged() -> None:
    medium = new_medium()
    medium.receive(START_NS, frame_message(0, bytes.fromhex("02aabbccddee")))
    assert receivers_of_frame(medium) == ([], False)


def test_interfaces_that_the_kernel_announces_receive_until_they_are_removed() -> None:
    medium, virtual = new_medium(), bytes.fromhex("02aabbccddee")
    for command, expected in ((CMD_ADD_MAC_ADDR, ([radio(2)], True)), (CMD_DEL_MAC_ADDR, ([], False))):
        medium.receive(START_NS, message(encode_generic(command, 1, {1: virtual, 2: radio(2)})))
        medium.receive(START_NS, frame_message(0, virtual))
        assert receivers_of_frame(medium) == expected


def test_an_interface_that_was_not_announced_is_found_by_its_frames() -> None:
    medium, virtual = new_medium(), bytes.fromhex("02aabbccddee")
    medium.receive(START_NS, frame_message(1, b"\xff" * 6, transmitter=virtual))
    assert receivers_of_frame(medium)[0] == [radio(0), radio(2)]
    medium.receive(2 * START_NS, frame_message(0, virtual))
    assert receivers_of_frame(medium) == ([radio(1)], True)


def test_a_radio_cannot_take_the_address_of_another_by_sending_with_it() -> None:
    medium = new_medium()
    medium.receive(START_NS, frame_message(2, b"\xff" * 6, transmitter=interface(1)))
    receivers_of_frame(medium)
    medium.receive(2 * START_NS, frame_message(0, interface(1)))
    assert receivers_of_frame(medium) == ([radio(1)], True)


def test_a_radio_that_changes_its_address_endlessly_uses_limited_memory() -> None:
    medium = new_medium()
    for number in range(1000):
        medium.receive(START_NS, frame_message(2, interface(1), transmitter=b"\x06" + number.to_bytes(5, "big")))
        list(replies_until_idle(medium))
    medium.receive(START_NS, frame_message(0, b"\x06" + (999).to_bytes(5, "big")))
    assert receivers_of_frame(medium) == ([], False)
    medium.receive(START_NS, frame_message(0, b"\x06" + (5).to_bytes(5, "big")))
    assert receivers_of_frame(medium) == ([radio(2)], True)


def test_errors_of_the_kernel_and_messages_of_unknown_radios_are_counted() -> None:
    medium = new_medium()
    medium.receive(START_NS, NetlinkMessage(NLMSG_ERROR, 0, 0, struct.pack("=i", -22)))
    medium.receive(START_NS, NetlinkMessage(NLMSG_ERROR, 0, 0, b"x"))
    medium.receive(START_NS, frame_message(9, interface(1)))
    medium.receive(START_NS, message(encode_generic(CMD_ADD_MAC_ADDR, 1, {1: interface(9), 2: radio(9)})))
    assert medium.counts.errors == {22: 1}
    assert medium.counts.rejected_messages == 3
    assert not list(replies_until_idle(medium))


@pytest.mark.parametrize("frequency_mhz", [0, 2411, 7126, 0xFFFFFFFF])
def test_a_frame_on_a_frequency_without_a_wifi_channel_is_rejected(frequency_mhz: int) -> None:
    medium = new_medium()
    frame = SentFrame(radio(0), bytes(30), 0, frequency_mhz, (), 1)
    medium.receive(START_NS, message(encode_sent(frame)))
    assert medium.counts.rejected_messages == 1


@given(st.binary(max_size=200))
def test_any_message_is_accepted_or_counted(payload: bytes) -> None:
    medium = new_medium()
    medium.receive(START_NS, message(payload))
    list(replies_until_idle(medium))


@given(st.binary(min_size=10, max_size=60), st.integers(0, 7), st.sampled_from([2412, 2437, 5180]))
def test_any_frame_of_a_robot_has_exactly_one_status(content: bytes, flags: int, frequency_mhz: int) -> None:
    medium = new_medium()
    frame = SentFrame(radio(0), content, flags, frequency_mhz, (RateStage(2, 2),), 5)
    medium.receive(START_NS, message(encode_sent(frame)))
    assert [command for command, _ in replies_until_idle(medium)].count(CMD_TX_INFO_FRAME) == 1


def test_each_frame_of_a_real_kernel_has_a_status() -> None:
    """The messages were recorded in an ad-hoc network; the list of sources is beside the recording."""
    medium, frames = new_medium(), 0
    recording = (ROOT / "tests/data/hwsim/6.1.176/ad-hoc.txt").read_text(encoding="ascii")
    for number, line in enumerate(recording.splitlines()):
        now_ns = START_NS + number * 100_000_000
        for netlink_message in decode_messages(bytes.fromhex(line)):
            is_frame = isinstance(decode_event(netlink_message.payload), SentFrame)
            medium.receive(now_ns, netlink_message)
            commands = [command for command, _ in replies_until_idle(medium, now_ns)]
            assert commands.count(CMD_TX_INFO_FRAME) == is_frame
            # Both other radios are in range and receive each broadcast.
            assert commands.count(CMD_FRAME) == 2 * is_frame
            frames += is_frame
    assert frames == 24
    assert medium.counts.rejected_messages == 0
