"""The air between radios: each try of a frame, its airtime, and its receivers."""

import math
from itertools import count

import pytest

from sim_backends.emulated.linux_wifi.air import Air, AirEvents, FrameOnAir
from sim_backends.emulated.linux_wifi.hwsim_messages import FLAG_NO_ACK, RATE_MCS, RadioAddress, RateStage, SentFrame
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.modes import ACK_BYTES, G_MODES, N_MODES, SIFS_NS, ack_ns, control_mode
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel

G54, G6, N7 = G_MODES[-1], G_MODES[0], N_MODES[-1]
STEADY = RadioOptions(fading=False)
ANTENNA = Antenna("802.11n", 15.0, -95.0)
FAR_M = 5000.0
START_NS = 10_000_000
LENGTH_BYTES = 1000


def frame(*stages: RateStage, group: bool = False, flags: int = 0, frequency_mhz: int = 2437) -> SentFrame:
    address = b"\xff" * 6 if group else bytes.fromhex("020000000200")
    content = b"\x08\x01\x00\x00" + address + bytes(LENGTH_BYTES - 10)
    return SentFrame(RadioAddress(bytes.fromhex("420000000100")), content, flags, frequency_mhz, stages, 1)


def air_with(distance_m: float, *, options: RadioOptions = STEADY) -> Air:
    air = Air(1, options, dict.fromkeys("ab", ANTENNA))
    air.place(0, {"a": (0.0, 0.0, 1.0), "b": (distance_m, 0.0, 1.0)})
    return air


def run(air: Air) -> tuple[AirEvents, int]:
    """Run until no frame is on the air; return the events and the time of the last one."""
    events, now_ns = AirEvents(), 0
    while (next_ns := air.next_event_ns()) is not None:
        new_events = air.pop_events(next_ns)
        events.receptions += new_events.receptions
        events.statuses += new_events.statuses
        if new_events.statuses:
            now_ns = next_ns
    return events, now_ns


def signal_dbm(distance_m: float) -> float:
    """Return the received power without fading, by the channel model of the radio."""
    channel = WorldChannel(1, dict.fromkeys("ab", ANTENNA), STEADY)
    channel.move(0, {"a": (0.0, 0.0, 1.0), "b": (distance_m, 0.0, 1.0)})
    return decibel(channel.powers_mw(0, 0)[1])


def test_a_fixed_mode_in_the_radio_options_has_no_effect() -> None:
    air = air_with(3.0, options=RadioOptions(fading=False, mode="a54"))
    air.transmit(START_NS, frame(RateStage(4, 1)), "a", "b")
    assert [reception.mode for reception in run(air)[0].receptions] == [G6]


@pytest.mark.parametrize(
    ("stage", "mode"), [(RateStage(11, 1), G54), (RateStage(4, 1), G6), (RateStage(7, 1, RATE_MCS), N7)]
)
def test_a_frame_takes_its_airtime_and_that_of_its_acknowledgement(stage: RateStage, mode: object) -> None:
    air = air_with(3.0)
    air.transmit(START_NS, frame(stage), "a", "b")
    events, end_ns = run(air)
    (status,), (reception,) = events.statuses, events.receptions
    assert status.is_acknowledged
    assert (reception.receiver, reception.mode) == ("b", mode)
    assert reception.signal_dbm == status.signal_dbm == round(signal_dbm(3.0))
    expected_ns = reception.mode.airtime_ns(LENGTH_BYTES + 4) + SIFS_NS + ack_ns(reception.mode)
    assert end_ns - START_NS == expected_ns


def test_tries_are_lost_as_often_as_the_packet_error_rate_of_their_mode() -> None:
    """Each frame has one try at 54 Mbit/s and then one at 6 Mbit/s, at a signal with which 54 Mbit/s often fails."""
    ack = control_mode(G54)
    distance_m = next(
        distance / 10
        for distance in range(10, 3000)
        if packet_error(G54, signal_dbm(distance / 10) + 95.0, LENGTH_BYTES + 4) > 0.4
    )
    snr_db = signal_dbm(distance_m) + 95.0
    loss_probability = packet_error(G54, snr_db, LENGTH_BYTES + 4)
    assert packet_error(G6, snr_db, LENGTH_BYTES + 4) < 1e-6
    assert packet_error(ack, snr_db, ACK_BYTES) < 1e-6
    frames = 2000
    air = air_with(distance_m, options=RadioOptions(fading=False, queue_packets=frames))
    for _ in range(frames):
        air.transmit(START_NS, frame(RateStage(11, 1), RateStage(4, 1)), "a", "b")
    events, _ = run(air)
    assert len(events.statuses) == len(events.receptions) == frames
    retried = sum(status.attempts == 2 for status in events.statuses)
    assert all(status.decoded_try == status.attempts for status in events.statuses)
    assert all(status.mode == (G54, G6)[status.decoded_try - 1] for status in events.statuses)
    assert all(status.chain.tries_made(status.attempts) in ([1], [1, 1]) for status in events.statuses)
    assert abs(retried - frames * loss_probability) < 4 * math.sqrt(
        frames * loss_probability * (1 - loss_probability)
    )


def test_all_tries_fail_out_of_range_and_need_airtime() -> None:
    air = air_with(FAR_M)
    air.transmit(START_NS, frame(RateStage(11, 2), RateStage(4, 3)), "a", "b")
    events, end_ns = run(air)
    (status,) = events.statuses
    assert not events.receptions
    assert not status.is_acknowledged
    assert status.chain.tries_made(status.attempts) == [2, 3]
    assert end_ns - START_NS > 2 * G54.airtime_ns(LENGTH_BYTES) + 3 * G6.airtime_ns(LENGTH_BYTES)


@pytest.mark.parametrize("receiver", [None, "a"])
def test_a_frame_to_an_address_without_another_radio_is_not_acknowledged(receiver: str | None) -> None:
    air = air_with(3.0)
    air.transmit(START_NS, frame(RateStage(11, 4)), "a", receiver)
    (status,) = run(air)[0].statuses
    assert (status.is_acknowledged, status.attempts) == (False, 4)


def test_a_frame_that_requests_no_acknowledgement_is_sent_once() -> None:
    air = air_with(FAR_M)
    air.transmit(START_NS, frame(RateStage(11, 4), flags=FLAG_NO_ACK), "a", "b")
    (status,) = run(air)[0].statuses
    assert status.attempts == 1


def test_a_broadcast_arrives_at_all_radios_in_range_and_is_not_acknowledged() -> None:
    air = Air(1, STEADY, dict.fromkeys("abcd", ANTENNA))
    air.place(0, {"a": (0.0, 0.0, 1.0), "b": (3.0, 0.0, 1.0), "c": (0.0, 3.0, 1.0), "d": (FAR_M, 0.0, 1.0)})
    air.transmit(START_NS, frame(RateStage(0, 1), group=True, flags=FLAG_NO_ACK), "a", None)
    events, _ = run(air)
    assert sorted(reception.receiver for reception in events.receptions) == ["b", "c"]
    (status,) = events.statuses
    assert (status.is_acknowledged, status.chain.tries_made(status.attempts)) == (False, [1])


def test_a_rate_that_the_model_does_not_have_fails_without_airtime() -> None:
    air = air_with(3.0)
    air.transmit(START_NS, frame(RateStage(15, 2, RATE_MCS)), "a", "b")
    events = air.pop_events(START_NS)
    (status,) = events.statuses
    assert (status.is_acknowledged, status.attempts, events.receptions) == (False, 0, [])


def test_radios_receive_frames_only_while_they_are_on_the_same_channel() -> None:
    air, times_ns = air_with(3.0), count(START_NS, 1_000_000_000)

    def is_acknowledged(source: str, receiver: str, frequency_mhz: int) -> bool:
        air.transmit(next(times_ns), frame(RateStage(4, 1), frequency_mhz=frequency_mhz), source, receiver)
        (status,) = run(air)[0].statuses
        return status.is_acknowledged

    results = [
        is_acknowledged("a", "b", 2437),  # b has not sent, so it may be on any channel
        is_acknowledged("b", "a", 2412),
        is_acknowledged("a", "b", 2437),
        is_acknowledged("b", "a", 2437),
        is_acknowledged("a", "b", 2437),
    ]
    assert results == [True, False, False, True, True]


def test_a_radio_defers_its_frame_while_another_is_on_the_air() -> None:
    """Two radios in range of each other: the second starts after the first one's ACK, so both arrive."""
    air = Air(1, STEADY, dict.fromkeys("abc", ANTENNA))
    air.place(0, {"a": (0.0, 0.0, 1.0), "b": (3.0, 0.0, 1.0), "c": (0.0, 3.0, 1.0)})
    air.transmit(START_NS, frame(RateStage(4, 1)), "a", "b")
    assert not air.pop_events(START_NS).statuses  # a is on the air
    air.transmit(START_NS + 100_000, frame(RateStage(4, 1)), "c", "b")
    events, end_ns = run(air)
    assert [status.is_acknowledged for status in events.statuses] == [True, True]
    assert end_ns - START_NS > 2 * G6.airtime_ns(LENGTH_BYTES)


def test_hidden_radios_collide() -> None:
    """Two radios that do not detect each other send at the same time to one between them, with equal power."""
    air = Air(1, STEADY, dict.fromkeys("abc", Antenna("802.11n", 15.0, -85.0)))
    distance_m = next(float(distance) for distance in range(1, 2000) if signal_dbm(distance) < -80.0)
    air.place(0, {"a": (-distance_m, 0.0, 1.0), "b": (0.0, 0.0, 1.0), "c": (distance_m, 0.0, 1.0)})
    for source in "ac":
        air.transmit(START_NS, frame(RateStage(4, 1)), source, "b")
    assert [status.is_acknowledged for status in run(air)[0].statuses] == [False, False]
    air.transmit(1_000_000_000, frame(RateStage(4, 1)), "a", "b")
    assert [status.is_acknowledged for status in run(air)[0].statuses] == [True]


def test_more_frames_than_the_queue_holds_are_reported_as_failed() -> None:
    air = air_with(3.0, options=RadioOptions(fading=False, queue_packets=2))
    for _ in range(6):
        air.transmit(START_NS, frame(RateStage(11, 1)), "a", "b")
    statuses: list[FrameOnAir] = run(air)[0].statuses
    assert sorted(status.is_acknowledged for status in statuses) == [False] * 3 + [True] * 3


@pytest.mark.parametrize("names", ["", ("a", "")])
def test_radios_need_names(names: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="at least one radio"):
        Air(1, STEADY, dict.fromkeys(names, ANTENNA))
