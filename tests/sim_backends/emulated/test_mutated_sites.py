"""Any site file and world file with an odd value is either used or refused with a message, without a traceback."""

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldkit.config import documents
from tests.helpers.nightly import examples
from tests.helpers.runs import run_here

SITE = documents.parse(
    """\
backend: emulated
control: separate
patience: 60s
robots:
  a: {profile: turtlebot3_burger, port: 22}
  b: {profile: turtlebot3_burger}
  c: {profile: duckiedrone}
roles:
  master: {sender: a, receiver: b, relay: c}
  masterless: {sender: a, receiver: b}
ros_master: sender
emulated:
  ros: builtin
  ros2: {discovery: multicast}
  world: garden
  robots: {a: {ssh: openssh, netcat: traditional, scripts: {tool: echo}}}
  late_bound: 100ms
  radio:
    exponent: 3
    shadowing_db: 1.0
    decorrelation: 10m
    k_db: 6
    stir_m_s: 0.1
    noise_floor_dbm: -95
    queue_packets: 1000
    access_points: {ap: {at_m: [3, 3], height: 2.5m, tx_power_dbm: 20}}
    roaming: {short: 30s, threshold_dbm: -65, long: 300s, channels: 11, dwell: 64ms}
    neighbours: {n: {at_m: [1, 2], duty: 20%}}
    microwave_ovens: {m: {at_m: [1, 2], mains_hz: 50}}
  physics: kinematic
  sync: {name: sliding_window, window: 2ms, step: 1ms}
""",
    source="",
).data
WORLD = documents.parse(
    """\
name: garden
summary: a garden
area_m: [46, 24]
obstacles:
  - {name: wall, kind: wall, from_m: [4, 14], to_m: [4, 22], height: 2.4m, thickness: 0.2m, material: brick}
  - {name: box, kind: box, centre_m: [20, 14], size_m: [2, 2, 2], yaw_deg: 10, base: 0m, material: wood}
  - {name: house, kind: building, centre_m: [30, 20], size_m: [5, 4, 3], thickness: 0.3m, material: brick}
  - {name: tree, kind: tree, at_m: [9, 9], height: 5m, crown_base: 2m, crown_radius: 1m, trunk_radius: 0.2m}
  - {name: hill, kind: raised, centre_m: [40, 5], size_m: [4, 4, 1]}
  - {name: slope, kind: ramp, centre_m: [35, 5], size_m: [6, 4, 1]}
lines:
  los: {from_m: [3, 6], bearing_deg: 90}
""",
    source="",
).data
ODD_VALUES: tuple[Any, ...] = (
    *(None, "", [], {}, [None], {"a": 1}, True, "x", "-x", " a b ", "\N{ROBOT FACE}", "a" * 3000, "[/x]", "../x"),
    *(0, -1, 1, 10**18, 1e308, -1e308, 5e-324, ".nan", ".inf", [0, 0], [1e6, -1e6], [1, 2, 3]),
    *("0m", "0s", "-1m", "0.0000000001s", "99999999999s", "0.0000000001m", "99999999999m", "30 ft", "100%", "1e400m"),
)


def locations(value: object, location: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the keys and indices of each value inside a value."""
    for key, item in (
        value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, list) else ())
    ):
        yield (*location, key)
        yield from locations(item, (*location, key))


def mutated(data: object, location: tuple[str | int, ...], value: object) -> object:
    copy = deepcopy(data)
    *parents, key = location
    container: Any = copy
    for parent in parents:
        container = container[parent]
    container[key] = value
    return copy


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "worlds").mkdir()
    return tmp_path


MUTATIONS = st.sampled_from([(data, location) for data in (SITE, WORLD) for location in locations(data)])


COMMANDS = ("lab sdf", "lab plot", "trial los 30ft --dry-run --topology masterless")


@given(mutation=MUTATIONS, value=st.sampled_from(ODD_VALUES), command=st.sampled_from(COMMANDS))
@settings(max_examples=examples(300), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_odd_value_causes_a_traceback(
    lab: Path, mutation: tuple[object, tuple[str | int, ...]], value: object, command: str
) -> None:
    data, location = mutation
    site, world = (mutated(data, location, value) if data is other else other for other in (SITE, WORLD))
    (lab / "fieldkit.yaml").write_text(documents.to_text(site), encoding="utf-8")
    (lab / "worlds" / "garden.yaml").write_text(documents.to_text(world), encoding="utf-8")
    run = run_here(lab, *command.split())
    assert run.code == 0 or (run.code == 2 and "error: " in run.err), run.err


def test_the_files_without_odd_values_are_used(lab: Path) -> None:
    site = mutated(SITE, ("emulated", "radio"), {})
    (lab / "fieldkit.yaml").write_text(documents.to_text(site), encoding="utf-8")
    (lab / "worlds" / "garden.yaml").write_text(documents.to_text(WORLD), encoding="utf-8")
    assert run_here(lab, "lab", "plot").code == 0
