"""Requests that the ns-3 program refuses with a reason; the coordinator sends few of them, but other clients may."""

import json
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import pytest

from sim_backends.cosim import load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.exchanges import AdvanceNetwork
from sim_backends.federates.frames import HEADER_BYTES, NETWORK, MessageKind, encode
from sim_backends.federates.handshake import Hello
from sim_backends.network.packets import Packet
from sim_backends.ns3.federate import command
from sim_backends.world.motion import State
from sim_backends.world.world import load_world
from tests.helpers.ns3_pair import SCENARIO

AGENTS = ("ann", "bob")
STATES = {name: State((10.0 * number, 0.0, 1.0)) for number, name in enumerate(AGENTS)}
PACKET = Packet(1, "ann", "bob", 100, ("state", 0), 1000, 1000, "udp")


@pytest.fixture(scope="module")
def hello(tmp_path_factory: pytest.TempPathFactory) -> Hello:
    path = tmp_path_factory.mktemp("ns3") / "line.yaml"
    path.write_text(SCENARIO, encoding="utf-8")
    scenario = load_scenario(path, {"network.federate": "ns3"})
    world = load_world(scenario.world)
    return make_hello(scenario, world, make_bodies(scenario, world), 1, NETWORK)


def hello_frame(hello: Hello, changes: Mapping[str, object] = MappingProxyType({})) -> bytes:
    """Return hello with changes of its configuration: values by their keys, `scenario/faults`."""
    configuration = json.loads(hello.configuration)
    for keys, value in changes.items():
        *parents, last_key = keys.split("/")
        item: Any = configuration
        for key in parents:
            item = item[key]
        item[last_key] = value
    changed_hello = replace(hello, configuration=json.dumps(configuration).encode())
    return encode(MessageKind.HELLO, 1, 0, changed_hello.encode())


def advance_frame(
    to_ns: int = 10_000_000,
    packets: Sequence[Packet] = (),
    *,
    announced_agents: Sequence[str] = AGENTS,
    copy_number: int = 0,
    extra_agent: str = "",
) -> bytes:
    states = {**STATES, **({extra_agent: State((0.0, 0.0, 1.0))} if extra_agent else {})}
    body = AdvanceNetwork(to_ns, states, packets).encode(AgentTable(announced_agents))
    return encode(MessageKind.ADVANCE_NETWORK, 2, copy_number, body)


def refusal(*frames: bytes) -> str:
    """Return the text of the error with which the program answers the last frame."""
    process = subprocess.run(
        shlex.split(command()), input=b"".join(frames), stdout=subprocess.PIPE, check=False, timeout=60
    )
    remaining, message_kinds, body = process.stdout, [], b""
    while remaining:
        size = int.from_bytes(remaining[:4], "little")
        message_kinds.append(remaining[4])
        body, remaining = remaining[HEADER_BYTES : HEADER_BYTES + size], remaining[HEADER_BYTES + size :]
    answers = [kind for kind in message_kinds if kind != MessageKind.BUSY]
    assert len(answers) == len(frames)
    assert answers[-1] == MessageKind.ERROR
    assert process.returncode == 1
    return body[2:].decode()


CLOUD = {"kind": "cloud", "name": "c", "centre_m": [0, 0], "size_m": [1, 1, 1], "yaw_deg": 0}
LOSS = {"kind": "node-loss", "agent": "eve", "from": "0s"}
JAMMER = {"kind": "jammer", "agent": "eve", "power_dbm": 1, "from": "0s"}
TOPIC = {"protocol": "topic", "from": "ann", "to": ["bob"]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"robots/ann/radio/pattern": {"axis": [0, 0, 1]}},
            "the antenna of ann has a pattern, which this network does not model",
        ),
        (
            {"robots": {"ann": {"radio": None}}},
            "the configuration is incomplete (select the network by its name, ns3): ",
        ),
        ({"world/obstacles": [CLOUD]}, "the world has an unknown kind of obstacle: cloud"),
        ({"scenario/faults": [LOSS]}, "there is no station eve"),
        ({"scenario/faults": [JAMMER], "jammers": [None]}, "there is no agent eve"),
        ({"scenario/radio/mode": "n3"}, "the mode n3 needs the standard 802.11n in all radios"),
        (
            {"options/topics": "udp", "scenario/traffic": [TOPIC]},
            "topics: udp carries best_effort topics only, but ann publishes a reliable topic",
        ),
    ],
    ids=lambda value: None if isinstance(value, str) else next(iter(value)),
)
def test_a_configuration_that_ns3_cannot_simulate_is_refused(
    changes: Mapping[str, object], message: str, hello: Hello
) -> None:
    assert refusal(hello_frame(hello, changes)).startswith(message)


Frames = Callable[[Hello], Sequence[bytes]]


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (lambda _: [advance_frame()], "hello is missing, or there is no such copy"),
        (lambda hello: [hello_frame(hello), hello_frame(hello)], "hello was sent twice"),
        (
            lambda hello: [hello_frame(hello), advance_frame(copy_number=3)],
            "hello is missing, or there is no such copy",
        ),
        (lambda hello: [hello_frame(hello), encode(MessageKind.FORK, 2, 0, b"\1\0\0\0")], "is not supported"),
        (
            lambda hello: [hello_frame(hello), encode(MessageKind.SAMPLE_LINKS, 2, 0, b"x")],
            "bytes follow the message",
        ),
        (lambda hello: [hello_frame(hello), advance_frame(5), advance_frame(4)], "time runs backwards to 4 ns"),
        (lambda hello: [hello_frame(hello), advance_frame(extra_agent="eve")], "an agent has appeared, which ns-3"),
        (
            lambda hello: [hello_frame(hello), advance_frame(announced_agents=[*AGENTS, "eve"], extra_agent="eve")],
            "agent 2 was not announced",
        ),
        (
            lambda hello: [hello_frame(hello), advance_frame(packets=[PACKET._replace(protocol="sctp")])],
            "there is no transport sctp",
        ),
        (
            lambda hello: [hello_frame(hello), advance_frame(packets=[PACKET._replace(size_bytes=70_000)])],
            "a packet of 70000 bytes is too large for udp",
        ),
        (
            lambda hello: [hello_frame(hello), advance_frame(packets=[PACKET, PACKET])],
            "packet 1 has entered before",
        ),
        (
            lambda hello: [
                hello_frame(hello, {"robots/bob/radio": None}),
                advance_frame(packets=[PACKET]),
            ],
            "agent 1 has no radio",
        ),
    ],
)
def test_a_wrong_request_is_refused(frames: Frames, message: str, hello: Hello) -> None:
    assert message in refusal(*frames(hello))
