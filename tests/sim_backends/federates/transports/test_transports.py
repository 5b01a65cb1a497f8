"""Each transport: addresses, tokens, order of starts, several runs, and large frames; the documentation lists all."""

import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Final

import pytest

from fieldkit.core.errors import ConfigurationError, FieldkitError
from sim_backends.federates.frames import NETWORK
from sim_backends.federates.handshake import AgentStart
from sim_backends.federates.protocols import UnansweredError
from sim_backends.federates.remote import open_network, open_physics
from sim_backends.federates.transports.contract import TOKEN_VARIABLE
from sim_backends.federates.transports.dds import DdsBus
from sim_backends.federates.transports.dds import parse as parse_dds
from sim_backends.federates.transports.transport_table import FORMS, TRANSPORTS, parse_address
from sim_backends.world.motion import State
from tests.helpers.faulty_federates import Federates, forked_federates
from tests.helpers.federate_pairs import HELLO
from tests.helpers.federate_transports import SCHEMES, new_addresses, ros_master
from tests.helpers.paths import ROOT

MS: Final = 1_000_000
MANY_AGENTS: Final = [
    AgentStart(f"r{number}", "husky", State((float(number), 0.0, 0.0), heading_rad=0.0)) for number in range(2000)
]

EARLY_WRITER: Final = """
import sys
from sim_backends.federates.transports.dds import DdsBus, parse

bus = DdsBus(parse(sys.argv[1]), read_topic="requests", write_topic="answers")
for sample in (b"busy", b"error", b"end"):
    bus.write(sample, None)
print("written", flush=True)
bus.write(bus.receive(None), None)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def federates() -> Iterator[Federates]:
    with ros_master(), forked_federates() as forked:
        yield forked


def test_the_documentation_lists_every_form_of_address() -> None:
    page = (ROOT / "docs" / "federates.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `((?:[a-z0-9]+)(?:-listen)?:[^`]*)` \|", page, re.MULTILINE)
    assert rows == FORMS


def test_examples_are_addresses() -> None:
    for transport in TRANSPORTS:
        for example in transport.example.split(" or "):
            assert parse_address(example) is not None


@pytest.mark.parametrize(
    "text", ["tcp:localhost", "udp:localhost:0", "udp-listen:7000", "dds:", "dds:a b", "dds:a:233", "ros1:a/b"]
)
def test_an_invalid_address_is_an_error(text: str) -> None:
    with pytest.raises(ConfigurationError, match="is not an address: "):
        parse_address(text)
    assert parse_address("python3 tcp:1:2") is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("tcp:localhost", "host or port is missing"),
        ("tcp:localhost:", "host or port is missing"),
        ("udp:localhost:65536", "'65536' is not a port from 1 to 65535"),
        ("tcp-listen:localhost:x", "'x' is not a port from 1 to 65535"),
    ],
)
def test_the_error_of_an_invalid_address_has_the_reason(text: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(reason)):
        parse_address(text)


@pytest.mark.parametrize(
    "address",
    ["tcp:192.0.2.1:7000", "udp:192.0.2.1:7000", "udp-listen:0.0.0.0:7000", "dds:carts:0:192.0.2.1", "ros1:carts"],
)
def test_a_token_is_needed_beyond_loopback(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    monkeypatch.setenv("ROS_MASTER_URI", "http://192.0.2.1:11311")
    with pytest.raises(ConfigurationError, match="there is no token"):
        open_physics(address, HELLO, 1.0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_federate_serves_several_runs_with_large_frames(scheme: str, federates: Federates) -> None:
    federate_address, address = new_addresses(scheme)
    federates.start("physics", "none", federate_address, runs=3)
    large_hello = replace(HELLO, agents=MANY_AGENTS)  # 144 kB of states in each answer
    for hello in (HELLO, large_hello, HELLO):
        with closing(open_physics(address, hello, 30.0)) as physics:
            for step in range(5):
                states = physics.advance(step * MS, {})
            assert states.keys() == {agent.name for agent in hello.agents}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_coordinator_may_start_first(scheme: str, federates: Federates) -> None:
    federate_address, address = new_addresses(scheme)
    federates.start("physics", "none", federate_address, delay_s=0.5)
    with closing(open_physics(address, HELLO, 30.0)) as physics:
        assert physics.advance(0, {})["ann"] == HELLO.agents[0].start


def test_a_federate_may_connect_by_udp(federates: Federates) -> None:
    listening_address, connecting_address = new_addresses("udp")
    federates.start("physics", "none", connecting_address)
    with closing(open_physics(listening_address, HELLO, 30.0)) as physics:
        assert physics.advance(0, {})


def test_a_hello_that_is_sent_before_discovery_arrives(federates: Federates, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sides discover each other at different times: the coordinator may send before the federate can receive."""
    monkeypatch.setattr(DdsBus, "has_peer", lambda _: True)
    federate_address, address = new_addresses("dds")
    federates.start("physics", "none", federate_address, delay_s=0.5)
    with closing(open_physics(address, HELLO, 30.0)) as physics:
        assert physics.advance(0, {})["ann"] == HELLO.agents[0].start


def test_the_last_answers_reach_a_coordinator_that_discovers_their_writer_late() -> None:
    """A writer keeps its last two samples, because the sample after an error is the end of the run."""
    address = new_addresses("dds")[1]
    with subprocess.Popen(
        (sys.executable, "-c", EARLY_WRITER, address), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "written\n"
        bus = DdsBus(parse_dds(address), read_topic="answers", write_topic="requests")
        try:
            assert [bus.receive(time.monotonic() + 60) for _ in range(2)] == [b"error", b"end"]
            bus.write(b"live", time.monotonic() + 60)
            assert bus.receive(time.monotonic() + 60) == b"live"
        finally:
            bus.close()
            writer.kill()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_federate_refuses_a_wrong_token(scheme: str, federates: Federates, monkeypatch: pytest.MonkeyPatch) -> None:
    federate_address, address = new_addresses(scheme)
    federates.start("physics", "none", federate_address)
    monkeypatch.setenv(TOKEN_VARIABLE, "wrong")
    with pytest.raises(FieldkitError, match="PermissionError: the token is wrong"):
        open_physics(address, HELLO, 30.0)


@pytest.mark.parametrize("scheme", ["dds", "ros1"])
def test_both_federates_of_a_run_may_use_one_transport(scheme: str, federates: Federates) -> None:
    addresses = [new_addresses(scheme) for _ in range(2)]
    for role, (federate_address, _) in zip(("physics", "network"), addresses, strict=True):
        federates.start(role, "none", federate_address)
    with (
        closing(open_physics(addresses[0][1], HELLO, 30.0)) as physics,
        closing(open_network(addresses[1][1], replace(HELLO, role=NETWORK), 30.0)) as network,
    ):
        for step in range(3):
            assert network.advance(step * MS, (), physics.advance(step * MS, {})) == ([], [])


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        ("udp", r"no connection to udp:127.0.0.1:\d+: .*refused for 0.3 s"),
        ("dds", "no federate has been discovered at dds:"),
        ("ros1", "no federate has been discovered at ros1:"),
    ],
)
def test_no_federate_within_the_deadline_is_an_error(scheme: str, message: str, federates: Federates) -> None:
    with pytest.raises(UnansweredError, match=message) as error_info:
        open_physics(new_addresses(scheme)[1], HELLO, 0.3)
    assert error_info.value.exit_code == 3


def test_no_master_within_the_deadline_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{port}")
    with pytest.raises(UnansweredError, match=f"no ROS master answers at http://127.0.0.1:{port}"):
        open_physics("ros1:carts", HELLO, 0.3)
