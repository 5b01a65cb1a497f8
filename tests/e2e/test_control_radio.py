"""With `control: radio`, SSH uses the radio under test, and the measured values are still correct."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.config.schema import parse, validate
from fieldkit.config.site import Site, load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.core.model import Control, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.medium.medium_stats import MediumStats
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.known_radio import make_lab, measured
from tests.helpers.nightly import mark_nightly
from tests.helpers.runs import only_trial, run_here
from tests.helpers.sshd import wait_until

FETCHED_BYTES = 1_000_000
LAPTOP_ADDRESS = bytes((10, 42, 0, 254))


def placement(distance: str, topology: Topology) -> Placement:
    return Placement(Scenario.LOS, topology, parse_distance(distance))


def test_control_is_separate_by_default() -> None:
    text = DEFAULT_SITE.read_text(encoding="utf-8")
    assert validate(parse(text, source="f"), Site).control is Control.SEPARATE
    assert validate(parse(f"{text}control: radio\n", source="f"), Site).control is Control.RADIO
    with pytest.raises(ConfigurationError, match="control"):
        validate(parse(f"{text}control: wifi\n", source="f"), Site)


def test_no_robot_may_have_the_laptops_name(tmp_path: Path) -> None:
    path = tmp_path / "fieldkit.yaml"
    text = DEFAULT_SITE.read_text(encoding="utf-8").replace("turtlebot-2", "laptop")
    path.write_text(f"{text}control: radio\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="'laptop' is reserved for the operator's laptop") as caught:
        EmulatedBackend(*load_site(path))
    assert caught.value.where.endswith("fieldkit.yaml:7")


@pytest.fixture(scope="module", params=Topology)
def emulation(request: pytest.FixtureRequest) -> Iterator[EmulatedTestbed]:
    cast = EmulatedBackend(None, None).cast(request.param)
    radio, ros = RadioOptions(fading=False), RosChoice.BUILTIN
    with testbed.bring_up(
        cast, options=EmulatedOptions(radio=radio), world=load_world("lawn"), ros=ros, seed=1, control=Control.RADIO
    ) as robots:
        robots.place(placement("10m", request.param))
        yield robots


@pytest.mark.emulated
def test_ssh_crosses_the_medium_like_the_packets_of_any_station(emulation: EmulatedTestbed) -> None:
    completed = emulation.shells[Role.SENDER].run(
        ("head", "-c", str(FETCHED_BYTES), "/dev/zero"), deadline=Deadline.after(30)
    )
    assert len(completed.stdout) == FETCHED_BYTES
    master = Role.RELAY in emulation.robots
    last_hop = "duckiedrone-1" if master else "turtlebot-1"

    samples: list[MediumStats] = []

    def is_idle() -> bool:  # no packet is in flight on a hop or to the laptop
        samples.append(stats := emulation.medium.stats())
        hop = stats.links[last_hop, "laptop"]
        return hop.sent == hop.delivered == stats.ports["laptop"].delivered_packets

    wait_until(is_idle, Deadline.after(30))
    stats = samples[-1]  # in a later sample, a packet may be in flight
    assert stats.ports["laptop"].delivered_packets > FETCHED_BYTES / 1500
    assert stats.links["turtlebot-1", "laptop"].sent == (0 if master else stats.ports["laptop"].delivered_packets)
    assert stats.links["turtlebot-1", emulation.robots[Role.RECEIVER].name].sent == 0


@pytest.mark.emulated
def test_a_robot_out_of_range_is_unreachable_until_it_returns(emulation: EmulatedTestbed) -> None:
    topology = Topology.MASTER if Role.RELAY in emulation.robots else Topology.MASTERLESS
    emulation.place(placement("1km", topology))
    with pytest.raises(LinkError):
        emulation.shells[Role.SENDER].run(("true",), deadline=Deadline.after(0.5))
    emulation.place(placement("10m", topology))
    assert emulation.shells[Role.SENDER].run(("echo", "back"), deadline=Deadline.after(30)).stdout == b"back\n"


@pytest.mark.emulated
@pytest.mark.parametrize("radio", mark_nightly(["{fading: false}", "{loss: 10%}"]))
def test_a_trial_is_valid_and_captures_no_ssh_packets(tmp_path: Path, radio: str) -> None:
    folder = make_lab(tmp_path / "lab", radio)
    site = folder / "fieldkit.yaml"
    site.write_text(site.read_text(encoding="utf-8") + "control: radio\n", encoding="utf-8")
    run = run_here(folder, "trial", "quick", "5m", "--repeats", "2")
    table = measured({folder: run})["lab"]
    assert [row["status"] for row in table] == ["valid"] * 4
    captures = [*only_trial(folder).glob("repeats/*-??/*.pcap")]
    assert len(captures) == 8
    assert not [path for path in captures if LAPTOP_ADDRESS in path.read_bytes()]


@pytest.mark.emulated
@pytest.mark.parametrize(("control", "word"), [("separate", "connects to 127.0.0.1"), ("radio", "shares the radio")])
def test_check_reports_the_network_of_ssh(tmp_path: Path, control: str, word: str) -> None:
    folder = make_lab(tmp_path / "lab", "{}")
    site = folder / "fieldkit.yaml"
    site.write_text(site.read_text(encoding="utf-8") + f"control: {control}\n", encoding="utf-8")
    run = run_here(folder, "check", "quick", "--json")
    assert run.code == 0, run.err + run.out
    findings = {finding["robot"]: finding for finding in run.events("finding") if finding["check"] == "control"}
    assert findings.keys() == {"turtlebot-1", "turtlebot-2"}
    for finding in findings.values():
        assert finding["status"] == "ok"
        assert word in finding["detail"]
