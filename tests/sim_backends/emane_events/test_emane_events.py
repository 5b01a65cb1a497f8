"""Events of EMANE: their bytes compared with those of protobuf, their axes with PROJ, and the channel on loopback."""

import json
import math
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any, Final

import pyproj
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.cli import main
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.emane_events.channel import EventListener, EventPublisher
from sim_backends.emane_events.events import (
    ALL_NEMS,
    LOCATION,
    PATHLOSS,
    EmaneVelocity,
    EventDatagram,
    NemLocation,
    NemPathloss,
    SerializedEvent,
    decode_locations,
    decode_pathlosses,
    encode_locations,
    encode_pathlosses,
)
from sim_backends.emane_events.geodesy import LocalFrame, emane_velocity, velocity_m_s
from sim_backends.emane_events.location_federate import EmaneLocations, _load
from sim_backends.emane_events.protobuf import MalformedEventError, varint_bytes
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import run_checks
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.protocols import FederateError, UnansweredError
from sim_backends.physics.body import Twist
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.world import load_world
from tests.helpers.federate_pairs import Pair
from tests.helpers.host import separate_namespaces

TURIN: Final = (45.06, 7.66, 240.0)
CHANNEL: Final = "224.1.2.8:45703"
UUID: Final = bytes(range(16))
LOCATIONS: Final = [
    NemLocation(1, 45.5, -7.25, 3.0, EmaneVelocity(90.0, -10.0, 1.5)),
    NemLocation(300, -33.0, 151.0, -2.5),
]
LOSSES: Final = [NemPathloss(2, 90.5, 91.0), NemPathloss(3, 120.0, 120.0)]

# Message, field, number, type and label, as in the .proto files of EMANE 1.5.
UINT32, UINT64, BYTES, DOUBLE, FLOAT = "UINT32", "UINT64", "BYTES", "DOUBLE", "FLOAT"
MESSAGES: Final = {
    "Serialization": [("nemId", 1, UINT32), ("eventId", 2, UINT32), ("data", 3, BYTES)],
    "Data": [("serializations", 1, "Serialization")],
    "Event": [("uuid", 1, BYTES), ("sequenceNumber", 2, UINT64), ("data", 3, "Data")],
    "Position": [("latitudeDegrees", 1, DOUBLE), ("longitudeDegrees", 2, DOUBLE), ("altitudeMeters", 3, DOUBLE)],
    "Velocity": [("azimuthDegrees", 1, DOUBLE), ("elevationDegrees", 2, DOUBLE), ("magnitude", 3, DOUBLE)],
    "Orientation": [("rollDegrees", 1, DOUBLE), ("pitchDegrees", 2, DOUBLE), ("yawDegrees", 3, DOUBLE)],
    "Location": [
        ("nemId", 1, UINT32),
        ("position", 2, "Position"),
        ("velocity", 3, "Velocity"),
        ("orientation", 4, "Orientation"),
    ],
    "LocationEvent": [("locations", 1, "Location")],
    "Pathloss": [("nemId", 1, UINT32), ("forwardPathlossdB", 2, FLOAT), ("reversePathlossdB", 3, FLOAT)],
    "PathlossEvent": [("pathlosses", 1, "Pathloss")],
}
REPEATED: Final = {"serializations", "locations", "pathlosses"}


@pytest.fixture(scope="module")
def messages() -> dict[str, Any]:
    """The classes of EMANE's messages, built by protobuf."""
    Field = descriptor_pb2.FieldDescriptorProto  # noqa: N806 (a class)
    file = descriptor_pb2.FileDescriptorProto(name="emane.proto", package="EMANEMessage")
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field, number, kind in fields:
            descriptor = message.field.add(name=field, number=number)
            descriptor.label = Field.LABEL_REPEATED if field in REPEATED else Field.LABEL_OPTIONAL
            if kind in MESSAGES:
                descriptor.type, descriptor.type_name = Field.TYPE_MESSAGE, f".EMANEMessage.{kind}"
            else:
                descriptor.type = getattr(Field, f"TYPE_{kind}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"EMANEMessage.{name}")) for name in MESSAGES
    }


def location_event(messages: dict[str, Any], **options: object) -> Any:  # noqa: ANN401 (a class made at run time)
    event = messages["LocationEvent"]()
    for location in LOCATIONS:
        message = event.locations.add(nemId=location.nem, **options)
        message.position.latitudeDegrees = location.latitude_deg
        message.position.longitudeDegrees = location.longitude_deg
        message.position.altitudeMeters = location.altitude_m
        if location.velocity is not None:
            message.velocity.azimuthDegrees = location.velocity.azimuth_deg
            message.velocity.elevationDegrees = location.velocity.elevation_deg
            message.velocity.magnitude = location.velocity.speed_m_s
    return event


def test_locations_have_the_bytes_of_protobuf(messages: dict[str, Any]) -> None:
    event = location_event(messages)
    assert encode_locations(LOCATIONS) == event.SerializeToString()
    assert decode_locations(event.SerializeToString()) == LOCATIONS
    with_orientation = location_event(messages, orientation=messages["Orientation"](yawDegrees=10.0))
    assert decode_locations(with_orientation.SerializeToString()) == LOCATIONS


def test_path_losses_have_the_bytes_of_protobuf(messages: dict[str, Any]) -> None:
    event = messages["PathlossEvent"]()
    for loss in LOSSES:
        event.pathlosses.add(nemId=loss.nem, forwardPathlossdB=loss.forward_db, reversePathlossdB=loss.reverse_db)
    assert encode_pathlosses(LOSSES) == event.SerializeToString()
    assert decode_pathlosses(event.SerializeToString()) == LOSSES


def test_a_datagram_has_the_bytes_of_protobuf_after_its_size(messages: dict[str, Any]) -> None:
    events = [SerializedEvent(ALL_NEMS, LOCATION, encode_locations(LOCATIONS)), SerializedEvent(7, PATHLOSS, b"")]
    event = messages["Event"](uuid=UUID, sequenceNumber=1 << 40)
    for serialized in events:
        event.data.serializations.add(nemId=serialized.nem, eventId=serialized.event, data=serialized.content)
    content = event.SerializeToString()
    datagram = EventDatagram(UUID, 1 << 40, events)
    assert datagram.encode() == struct.pack("!H", len(content)) + content
    assert EventDatagram.decode(datagram.encode()) == datagram


def test_a_datagram_has_the_bytes_written_by_hand() -> None:
    """The bytes follow from the layout of the messages."""
    content = b"\x0a\x10" + UUID + b"\x10\xac\x02" + b"\x1a\x0e" + b"\x0a\x0c" + b"\x08\x05\x10\x65\x1a\x06"
    loss = b"\x0a\x04\x08\x02\x15\x00"  # truncated, which the decoder of datagrams does not check
    datagram = EventDatagram(UUID, 300, [SerializedEvent(5, PATHLOSS, loss)])
    assert datagram.encode() == b"\x00\x25" + content + loss
    assert EventDatagram.decode(b"\x00\x25" + content + loss) == datagram
    with pytest.raises(MalformedEventError):
        decode_pathlosses(loss)


def with_size(content: bytes) -> bytes:
    return struct.pack("!H", len(content)) + content


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"\x00",
        b"\x00\x05abc",
        with_size(b""),
        with_size(b"\x0a\x02ab"),
        with_size(b"\x0a\x7f"),
        with_size(b"\x0b"),
        with_size(b"\x80" * 11),
        EventDatagram(UUID, 1, [SerializedEvent(1, 100, b"x")]).encode()[:-1],
    ],
)
def test_a_malformed_datagram_is_refused(datagram: bytes) -> None:
    with pytest.raises(MalformedEventError):
        EventDatagram.decode(datagram)


@given(
    position=st.integers(0, 200),
    replacement=st.binary(max_size=4),
    content=st.sampled_from([encode_locations(LOCATIONS), encode_pathlosses(LOSSES)]),
)
def test_altered_bytes_give_an_event_or_the_error(position: int, replacement: bytes, content: bytes) -> None:
    datagram = EventDatagram(UUID, 1, [SerializedEvent(1, 100, content)]).encode()
    altered_datagram = datagram[:position] + replacement + datagram[position + len(replacement) :]
    for decode in (EventDatagram.decode, lambda data: EventDatagram.decode(with_size(data[2:]))):
        with suppress(MalformedEventError):
            for event in decode(altered_datagram).events:
                for decode_content in (decode_locations, decode_pathlosses):
                    with suppress(MalformedEventError):
                        assert isinstance(decode_content(event.content), list)


def test_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="not an unsigned integer"):
        varint_bytes(-1)
    with pytest.raises(ValueError, match="too large"):
        EventDatagram(UUID, 1, [SerializedEvent(1, 100, bytes(70_000))]).encode()
    with pytest.raises(MalformedEventError, match="not finite"):
        decode_locations(encode_locations([NemLocation(1, math.nan, 0.0, 0.0)]))


@pytest.mark.parametrize("reference", [(0.0, 0.0, 0.0), TURIN, (-89.0, -179.9, 10.0)])
def test_positions_agree_with_proj(reference: tuple[float, float, float]) -> None:
    latitude, longitude, height_m = reference
    proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={latitude} +lon_0={longitude} +h_0={height_m}"
    )
    frame = LocalFrame(reference)
    for position_m in ((0.0, 0.0, 0.0), (120.0, -40.0, 8.5), (-3000.0, 20000.0, 100.0)):
        geodetic_position = frame.geodetic(position_m)
        assert proj.transform(geodetic_position[1], geodetic_position[0], geodetic_position[2]) == pytest.approx(
            position_m, abs=1e-6
        )
        assert frame.position_m(geodetic_position) == pytest.approx(position_m, abs=1e-6)
    north, east = frame.geodetic((0.0, 100.0, 0.0)), frame.geodetic((100.0, 0.0, 0.0))
    assert north[0] > latitude
    assert east[1] != longitude


def test_velocities_have_emanes_axes() -> None:
    assert emane_velocity((0.0, 2.0, 0.0)) == EmaneVelocity(0.0, 0.0, 2.0)
    west = emane_velocity((-1.0, 0.0, 1.0))
    assert (west.azimuth_deg, west.elevation_deg) == pytest.approx((270.0, 45.0))
    assert velocity_m_s(west) == pytest.approx((-1.0, 0.0, 1.0))


@pytest.fixture
def network() -> Iterator[None]:
    """A separate network namespace, which has loopback only."""
    with separate_namespaces():
        yield


def receive_all(listener: EventListener, limit_s: float = 0.0) -> list[SerializedEvent]:
    events: list[SerializedEvent] = []
    while (event := listener.receive(limit_s)) is not None:
        events += event
    return events


@pytest.mark.emulated
def test_a_run_publishes_positions_and_path_losses(
    network: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    listener = EventListener(CHANNEL, "lo")
    try:
        words = ["cosim", "run", "convoy", "--duration", "450ms", "--emane-events", CHANNEL, "--emane-device", "lo"]
        options = "emane.reference=[45.06, 7.66, 240]", "emane.nems={leader: 7, follower: 8, drone: 9}"
        code = main([*words, *(word for option in options for word in ("--set", option))])
        assert code == 0, capsys.readouterr().err
        events = receive_all(listener)
    finally:
        listener.close()
    locations = [decode_locations(event.content) for event in events if event.event == LOCATION]
    assert len(locations) == 5  # at 0, 0.1, ..., 0.4 s
    frame = LocalFrame(TURIN)
    first_locations = {location.nem: location for location in locations[0]}
    assert {event.nem for event in events if event.event == LOCATION} == {ALL_NEMS}
    drone = (first_locations[9].latitude_deg, first_locations[9].longitude_deg, first_locations[9].altitude_m)
    assert frame.position_m(drone) == pytest.approx((19.0, 12.0, 8.0), abs=1e-6)
    assert locations[-1][0].velocity is not None
    assert locations[-1][0].velocity.azimuth_deg == pytest.approx(90.0, abs=1.0)  # the leader drives east
    losses = {event.nem: decode_pathlosses(event.content) for event in events if event.event == PATHLOSS}
    assert {nem: [loss.nem for loss in others] for nem, others in losses.items()} == {
        7: [8, 9],
        8: [7, 9],
        9: [7, 8],
    }
    assert losses[7][0].forward_db == losses[8][0].forward_db == losses[7][0].reverse_db
    assert 40 < losses[7][0].forward_db < 70  # at a distance of 2 m


STANDING: Final = """
name: pair
summary: two robots that stand
world: open
duration: 500ms
agents:
  one: {robot: husky, at_m: [10, 20], radio: {}}
  two: {robot: husky, at_m: [30, 20], radio: {}}
traffic:
  - {kind: stream, from: one, to: two, rate: 20Hz}
"""


@contextmanager
def publishing(*positions_m: tuple[float, float, float], losses: Sequence[SerializedEvent] = ()) -> Iterator[None]:
    """Publish path losses and locations of NEM 1, 2, ... repeatedly, with a malformed datagram before them."""
    publisher = EventPublisher(CHANNEL, "lo")
    frame, closed = LocalFrame(TURIN), threading.Event()
    velocity = EmaneVelocity(90.0, 0.0, 2.0)
    locations = [NemLocation(nem, *frame.geodetic(position), velocity) for nem, position in enumerate(positions_m, 1)]

    def publish() -> None:
        while not closed.is_set():
            publisher.publish([SerializedEvent(ALL_NEMS, LOCATION, b"\x0a\x05")])
            publisher.publish([*losses, SerializedEvent(ALL_NEMS, LOCATION, encode_locations(locations))])
            closed.wait(0.05)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        closed.set()
        thread.join()
        publisher.close()


@pytest.mark.emulated
def test_agents_follow_events(network: None, tmp_path: Path) -> None:
    path = tmp_path / "pair.yaml"
    path.write_text(STANDING, encoding="utf-8")
    options = {"device": "lo", "reference": list(TURIN)}
    scenario = load_scenario(path, {"physics.federate": "emane", "physics.options": options})
    with pytest.raises(
        UnansweredError, match=r"no location of one \(NEM 1\), two \(NEM 2\) has arrived on 224.1.2.8"
    ):
        build(load_scenario(path, {"physics.federate": "emane", "physics.options": options | {"wait": "200ms"}}))
    with publishing((12.0, 20.0, 0.5), (32.0, 20.0, 0.5)), build(scenario, policy="sliding_window") as simulation:
        start_s = time.monotonic()
        simulation.run()
        duration_s = time.monotonic() - start_s
        states = simulation.agents.states(scenario.duration_ns)
    assert states["one"].position_m == pytest.approx((12.0, 20.0, 0.5), abs=1e-6)
    assert states["one"].velocity_m_s == pytest.approx((2.0, 0.0, 0.0), abs=1e-9)
    assert duration_s > 0.3, "it runs in real time"


def loss_event(messages: dict[str, Any], receiver_nem: int, **losses_db: tuple[float, float]) -> SerializedEvent:
    """Return an event for a NEM with the bytes of protobuf: forward and reverse losses by the other NEM."""
    event = messages["PathlossEvent"]()
    for nem, (forward_db, reverse_db) in losses_db.items():
        event.pathlosses.add(nemId=int(nem[1:]), forwardPathlossdB=forward_db, reversePathlossdB=reverse_db)
    return SerializedEvent(receiver_nem, PATHLOSS, event.SerializeToString())


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("uses_event_losses", "expected"), [(True, {"two": False, "far": True}), (False, {"two": True, "far": False})]
)
def test_path_losses_of_events_replace_those_of_the_world(
    network: None, tmp_path: Path, messages: dict[str, Any], expected: dict[str, bool], *, uses_event_losses: bool
) -> None:
    """As in EMANE, a receiver uses the forward loss from each transmitter, and no reverse loss."""
    path = tmp_path / "pair.yaml"
    path.write_text(STANDING, encoding="utf-8")
    changes = {
        "agents.far": {"robot": "husky", "at_m": [10, 50], "radio": {}},
        "traffic": [{"kind": "stream", "name": "state", "from": "one", "to": ["two", "far"], "rate": "20Hz"}],
        "physics.federate": "emane",
        "physics.options": {"device": "lo", "reference": list(TURIN), "pathloss": uses_event_losses},
    }
    losses = [
        loss_event(messages, 1, n2=(150.0, 60.0), n3=(70.0, 150.0), n77=(1.0, 1.0)),
        loss_event(messages, 2, n1=(150.0, 60.0)),
        loss_event(messages, 3, n1=(70.0, 150.0)),
        SerializedEvent(1, PATHLOSS, b"\x0a\x05"),
    ]
    places_m = (12.0, 20.0, 0.5), (32.0, 20.0, 0.5), (9_000.0, 20.0, 0.5)
    with publishing(*places_m, losses=losses), build(load_scenario(path, changes), policy="scheduled") as simulation:
        run = simulation.run()
    for name, arrives in expected.items():
        outcomes = {fate.arrived_ns is not None for fate in run.fates.values() if fate.packet.destination == name}
        assert outcomes == {arrives}


def test_path_losses_of_events_have_a_direction() -> None:
    antennas = {name: Antenna("802.11g", 17.0, -82.0) for name in ("a", "b", "c")}
    channel = WorldChannel(1, antennas, RadioOptions.model_validate({"fading": False}))
    channel.move(0, {"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0), "c": (20.0, 0.0, 1.0)})
    before_db = {(first, second): channel.snr_db(first, second) for first, second in permutations(range(3), 2)}
    noise_dbm = 10 * math.log10(channel.noise_mw[0])
    channel.use_path_losses({("a", "b"): 90.0, ("b", "a"): 100.0, ("a", "unknown"): 1.0})
    assert channel.snr_db(0, 1) == pytest.approx(17 - 90 - noise_dbm)
    assert channel.snr_db(1, 0) == pytest.approx(17 - 100 - noise_dbm)
    assert channel.snr_db(1, 2) == before_db[1, 2]
    assert not channel.are_linked(0, 1)
    assert not channel.are_linked(1, 0), "at -83 dBm, below the sensitivity"
    channel.use_path_losses({})
    assert {pair: channel.snr_db(*pair) for pair in before_db} == before_db


@pytest.mark.emulated
def test_the_physics_emane_passes_the_conformance_checks(network: None) -> None:
    scenario = load_scenario("convoy", {"physics.options": {"device": "lo", "reference": list(TURIN)}})
    world = load_world(scenario.world)
    hello = make_hello(scenario, world, make_bodies(scenario, world), 1, PHYSICS)
    start_positions_m = [agent.start.position_m for agent in hello.agents]
    with publishing(*start_positions_m):
        results = list(run_checks(Target(Pair(_load()), hello, windows=100)))
    assert [result for result in results if result.failure] == []
    check_names = {result.name for result in results if not result.skipped}
    assert {"start", "remainders", "unknown_command", "fork_absence"} <= check_names


@pytest.mark.emulated
def test_commands_and_invalid_options_of_the_physics_emane_are_refused(network: None) -> None:
    scenario = load_scenario("convoy", {"physics.options": {"device": "lo"}})
    world = load_world(scenario.world)
    hello = make_hello(scenario, world, make_bodies(scenario, world), 1, PHYSICS)
    physics = EmaneLocations(hello)
    with pytest.raises(FederateError, match="does not move robots, but there is a command for leader"):
        physics.advance(0, {"leader": Twist()})
    physics.close()
    for options, message in (
        ({"channel": "10.0.0.1:45703"}, "not a multicast group and port"),
        ({"nems": {"leader": 1}}, "nems must list each agent once: follower is missing"),
        ({"nems": {"leader": 1, "follower": 1, "drone": 2}}, "two agents have the same identifier"),
    ):
        changed_hello = replace(hello, configuration=json.dumps({"options": options}).encode())
        with pytest.raises(ValueError, match=message):
            EmaneLocations(changed_hello)
    with pytest.raises(ConfigurationError, match="there is no network interface 'none0'"):
        EventListener(CHANNEL, "none0")


def test_only_one_run_publishes(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["cosim", "run", "convoy", "--seeds", "2", "--emane-events", CHANNEL]
    assert main(words) == 2
    assert "only one run can publish events of EMANE" in capsys.readouterr().err
