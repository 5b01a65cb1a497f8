"""Robots that forward for each other: a row of six of which only neighbours hear each other, with Debian's babeld."""

import re
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise

import pytest

from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.lab.protocol import LabRobot
from fieldkit.remote.ssh import SshShell
from sim_backends.emulated import requirements
from sim_backends.emulated.options import EmulatedOptions, RosChoice
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.startup import RunningRobots, running_robots
from sim_backends.world.world import load_world
from tests.helpers.labs import BOX

NAMES = ("r1", "r2", "r3", "r4", "r5", "r6")
ADDRESSES = {name: f"10.42.0.{number}" for number, name in enumerate(NAMES, 1)}
# 17 dBm less 40.2 dB for the first metre (2.437 GHz) and 53.3 dB up to 60 m arrive as -76.5 dBm, 6 dB above what the
# radio detects at least; twice as far away 9 dB less, which is below it.
APART_M = 60.0
FIRST_TTL = 64
LONG_S = 60.0


@pytest.fixture(scope="module")
def row() -> Iterator[RunningRobots[str]]:
    profile = schema.validate(schema.parse(BOX, source="box.yaml"), RobotProfile)
    text = "{radio: {fading: false}, mesh: {daemon: babeld, hello: 0.5s}}"
    options = schema.validate(schema.parse(text, source="fieldkit.yaml"), EmulatedOptions)
    members = {name: LabRobot(name, profile, address, ()) for name, address in ADDRESSES.items()}
    with running_robots(members, options=options, world=load_world("open"), ros=RosChoice.BUILTIN, seed=1) as up:
        up.medium.place({name: (APART_M * number, 0.0, 0.2) for number, name in enumerate(NAMES)})
        yield up


@pytest.fixture(scope="module")
def first(row: RunningRobots[str]) -> Iterator[SshShell]:
    """The shell of the first robot, once its routing daemon has found the way to the last."""
    with ExitStack() as stack:
        shell = SshShell(
            "r1",
            connect=row.robots["r1"].connect,
            user=USER,
            host_key=row.host_keys["r1"],
            private_key=row.private_key,
        )
        stack.callback(shell.close)
        deadline = Deadline.after(LONG_S)
        while " 0% packet loss" not in ping(shell, "r6", "-c", "1"):
            assert not deadline.expired, said(shell, "ip", "route")
            time.sleep(0.2)
        yield shell


def said(shell: SshShell, *argv: str) -> str:
    return shell.run(argv, deadline=Deadline.after(LONG_S), check=False).stdout.decode()


def ping(shell: SshShell, name: str, *options: str) -> str:
    return said(shell, "ping", "-n", "-W", "1", *options, ADDRESSES[name])


@pytest.mark.emulated
def test_packets_cross_five_hops_each_of_which_takes_one_of_their_time_to_live(first: SshShell) -> None:
    text = ping(first, "r6", "-c", "20", "-i", "0.05")
    assert re.findall(r"ttl=(\d+)", text) == [str(FIRST_TTL - 4)] * 20, text


@pytest.mark.emulated
def test_the_way_is_a_traceroute_along_the_row(first: SshShell) -> None:
    for ttl, (_, name) in enumerate(pairwise(NAMES[:-1]), 1):
        assert f"From {ADDRESSES[name]} icmp_seq=1 Time to live exceeded" in ping(
            first, "r6", "-c", "1", "-t", str(ttl)
        )
    assert "ttl=60" in ping(first, "r6", "-c", "1", "-t", "5")


@pytest.mark.emulated
def test_only_neighbours_hear_each_other(row: RunningRobots[str], first: SshShell) -> None:
    assert "ttl=60" in ping(first, "r6", "-c", "1")
    heard = {pair for pair, link in row.medium.stats().links.items() if link.delivered}
    assert heard == {*pairwise(NAMES), *pairwise(reversed(NAMES))}


@pytest.mark.emulated
def test_every_way_is_babels_and_goes_by_the_neighbour(first: SshShell) -> None:
    routes = said(first, "ip", "-4", "route", "show", "proto", "babel").splitlines()
    assert {line.split(" dev")[0] for line in routes} == {f"{ADDRESSES[name]} via 10.42.0.2" for name in NAMES[1:]}


@pytest.mark.emulated
def test_a_multicast_reaches_neighbours_and_is_not_forwarded(first: SshShell) -> None:
    text = said(first, "ping", "-n", "-c", "2", "-i", "0.2", "-W", "1", "ff02::1%wlan0")
    assert set(re.findall(r"bytes from (\S+?)%wlan0:", text)) - {"fe80::aff:fe2a:1"} == {"fe80::aff:fe2a:2"}


def test_a_missing_daemon_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name, **_: None if name == "babeld" else f"/bin/{name}")
    with pytest.raises(ConfigurationError) as raised:
        requirements.check({"babeld"})
    assert raised.value.what == "emulated robots need programs that are not installed: babeld"
    assert raised.value.remedy.endswith("apt-get install --no-install-recommends babeld")
