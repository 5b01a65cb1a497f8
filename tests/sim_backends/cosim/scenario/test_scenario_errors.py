"""Wrong scenarios are refused before anything runs, with a message, a line and a remedy."""

import re
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.scenario import checks
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.physics import robot_limits
from sim_backends.physics.robot_limits import HUSKY_A200

SCENARIO = """\
name: meadow
summary: for tests
world: open
duration: 2s
policy: {name: sliding_window, window: 5ms}
topology: masterless
agents:
  one: {robot: turtlebot3_burger, at_m: [10, 10]}
  two:
    robot: turtlebot3_burger
    at_m: [20, 10]
    motion:
      kind: follow
      leader: one
      distance: 2m
  three: {robot: cart, at_m: [30, 10]}
traffic:
  - {kind: stream, from: one, to: two, rate: 10Hz}
  - kind: bag
    from: two
    to: [one]
    rate: 50Hz
faults:
  - {kind: node-loss, agent: one, from: 500ms, to: 1s}
"""

WRONG = [
    ("name: sliding_window", "name: sliding", 5, "no sync policy 'sliding'; did you mean 'sliding_window'"),
    ("name: sliding_window", "name: best", 5, "policies: event_driven, .*, error_bounded"),
    ("window: 5ms", "window: 0ms", 5, "greater than 0"),
    ("window: 5ms", "window: -5ms", 5, "duration '-5ms' is below zero; write for example 15s or 15ms"),
    ("window: 5ms", "window: 5", 5, "'5' has no unit; write for example 5s or 5ms"),
    ("window: 5ms", "window: 0.5ms", 5, "window of 0.0005 s is shorter than the physics step, 0.001 s"),
    (
        "window: 5ms",
        "window: 0.9999999ms",
        5,
        "window of 0.0009999999 s is shorter than the physics step, 0.001 s",
    ),
    ("window: 5ms", "windows: 5ms", 5, "unknown key windows; did you mean 'window'"),
    ("world: open", "world: opem", 3, "no world 'opem'.*\n.*did you mean 'open'"),
    ("duration: 2s", "duration: 0s", 4, "greater than 0"),
    ("duration: 2s", "duration: 2s\nseeds: [-1]", 5, "greater than or equal to 0"),
    ("duration: 2s\n", "", 1, "required key 'duration' is missing"),
    ("topology: masterless", "topology: master", 6, "the topology master needs a relay: AGENT"),
    ("topology: masterless", "relay: for", 6, "no agent 'for'; did you mean 'four'|agents: one, two, three"),
    ("  one: {robot", "  ONE: {robot", 8, "'ONE' cannot be a key here"),
    ("robot: turtlebot3_burger, at_m", "robot: turtlebot3, at_m", 8, "no robot 'turtlebot3'.*\n.*turtlebot3_burger"),
    ("burger, at_m: [10, 10]", "burger", 8, r"either at_m: \[EAST, NORTH\], or along: 20m"),
    ("at_m: [10, 10]", "at_m: [10, 10], along: 3m", 8, "either at_m"),
    ("at_m: [10, 10]", "along: 3m, aside_m: x", 8, "valid number|a number"),
    ("at_m: [10, 10]", "at_m: [10]", 8, "this list needs more values"),
    ("at_m: [10, 10]", "at_m: [1000001, 10]", 8, "less than or equal to 1000000"),
    ("at_m: [10, 10]", "at_m: 10", 8, "a list is needed here"),
    ("at_m: [10, 10]", "at_m: [10, 10], height: 3m", 8, "turtlebot3_burger does not fly"),
    ("at_m: [20, 10]", "at_m: [10.1, 10]", 9, "two starts within one"),
    (
        "kind: follow\n      leader: one\n      distance: 2m",
        "kind: station-keeping",
        12,
        "turtlebot3_burger does not fly, and only robots that fly keep their station",
    ),
    ("kind: follow", "kind: folow", 12, "no kind 'folow'; did you mean 'follow'"),
    ("      kind: follow\n", "", 12, "required key 'kind' is missing"),
    ("leader: one", "leader: noone", 14, "no agent 'noone'; did you mean 'one'"),
    (
        "leader: one",
        "leader: [one, three]",
        12,
        "two follows three, but receives no states from it; add to the traffic",
    ),
    ("distance: 2m", "distance: 0m", 15, "greater than 0"),
    ("from: one, to: two", "from: one, to: twö", 18, "'twö' is not a name of at most 31 lower-case letters"),
    ("from: one, to: two", "from: one, to: tow", 18, "no agent 'tow'; did you mean 'two'"),
    ("from: one, to: two", "from: one, to: one", 18, "one is both the sender and a receiver"),
    ("from: one, to: two", "from: one, to: []", 18, "at least 1 item"),
    ("from: one, to: two", "from: one, to: [two, two]", 18, "listed twice"),
    ("to: [one]", "to: [three]", 16, "three sends, receives or relays packets, but has no radio"),
    ("to: two, rate", "to: two, protocol: dds, rate", 18, "'dds' is not one of: udp, tcp, topic, ros1, ros1-udp"),
    ("to: two, rate", "to: two, protocol: ros1, rate", 18, "ros1 needs a master: set its host with relay: AGENT"),
    (
        "to: two, rate",
        "to: two, qos: {depth: 3}, rate",
        18,
        "only the protocol topic has a qos, but the protocol is udp",
    ),
    ("rate: 10Hz", "rate: 10", 18, "'10' has no unit; write for example 10Hz"),
    ("rate: 10Hz", "rate: 10Hz, size_bytes: 70000", 18, "less than or equal to 65000"),
    ("kind: bag", "name: one-stream\n    kind: bag", 19, "two entries of the traffic have the name 'one-stream'"),
    (
        "kind: bag",
        "length: 1000000s\n    kind: bag",
        19,
        "at most 1,000,000 messages, and 1e[+]06 s of 50 Hz are 50,000,000",
    ),
    ("stream, from: one, to: two, rate: 10Hz", "ping, from: one, to: two, interval: 1us", 18, "equal to 0.00001"),
    ("kind: node-loss", "kind: nodeloss", 24, "no kind 'nodeloss'; did you mean 'node-loss'"),
    ("agent: one, from", "agent: on, from", 24, "no agent 'on'; did you mean 'one'"),
    ("from: 500ms, to: 1s", "from: 2s, to: 1s", 24, "the end at 1 s is not after the beginning at 2 s"),
    ("node-loss, agent: one", "jammer, power_dbm: 20", 24, r"needs either at_m: \[EAST, NORTH\], or an agent: NAME"),
    ("node-loss, agent: one", "link-cut, between: [one]", 24, "this list needs more values"),
    ("node-loss, agent: one", "link-cut, between: [one, one]", 24, "one has no link to itself"),
    ("faults:\n", "faults:\n  - &x {}\n  - *x\n", 25, "aliases"),
]


@pytest.fixture(autouse=True)
def _a_body_without_a_profile(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add a body without a profile; every shipped body has a profile, and with it a radio."""
    monkeypatch.setitem(robot_limits.BODIES, "cart", HUSKY_A200)


def loading_error(text: str, folder: Path) -> ConfigurationError:
    with pytest.raises(ConfigurationError) as error_info:
        load_scenario(write_scenario(text, folder))
    return error_info.value


@pytest.mark.parametrize(
    ("old_text", "new_text", "line", "message"), WRONG, ids=lambda value: str(value).strip()[:40]
)
def test_an_error_has_its_line_and_a_remedy(
    old_text: str, new_text: str, line: int, message: str, tmp_path: Path
) -> None:
    assert SCENARIO.count(old_text) >= 1
    error = loading_error(SCENARIO.replace(old_text, new_text, 1), tmp_path)
    assert re.search(message, str(error)), str(error)
    assert error.where == f"{tmp_path / 'meadow.yaml'}:{line}"
    assert error.remedy


def test_the_scenario_without_errors_runs(tmp_path: Path) -> None:
    text = SCENARIO.replace("kind: follow", "kind: standing").replace("      leader: one\n      distance: 2m\n", "")
    run = build(load_scenario(write_scenario(text, tmp_path))).run(100_000_000)
    assert run.windows_ns == [number * 5_000_000 for number in range(1, 21)]


def test_a_jammer_among_fixed_links_is_refused(tmp_path: Path) -> None:
    text = SCENARIO.replace("node-loss, agent: one", "jammer, power_dbm: 20, agent: one")
    error = loading_error(text.replace("topology: masterless", "radio: {loss: 10%}"), tmp_path)
    assert "fixed links ignore a jammer" in error.what
    assert error.where.endswith(":24")


def test_a_robot_that_drives_cannot_follow_several_leaders(tmp_path: Path) -> None:
    text = SCENARIO.replace("leader: one", "leader: [one, three]").replace(
        "{robot: cart,", "{robot: cart, radio: {},"
    )
    text = text.replace("to: [one]", "to: [one, three]")
    text = text.replace("faults:", "  - {kind: stream, from: three, to: two, rate: 10Hz}\nfaults:")
    error = loading_error(text, tmp_path)
    assert "does not fly, and only robots that fly follow several leaders" in error.what
    assert error.where.endswith(":14")
    assert error.remedy == "choose one of one, three"


def test_an_unknown_scenario_is_reported_with_the_existing_ones() -> None:
    with pytest.raises(ConfigurationError, match=r"no scenario 'bayland'.*\n.*did you mean 'baylands'"):
        load_scenario("bayland")
    with pytest.raises(ConfigurationError, match=r"scenarios: baylands, .*; or give a file that ends in .yaml"):
        load_scenario("xyz")
    with pytest.raises(ConfigurationError, match=r"nowhere.yaml: cannot be read"):
        load_scenario("nowhere.yaml")


TOO_FAST = [
    (
        "husky",
        "kind: way-points, points_m: [[20, 10]], speed: 1.01m/s",
        "a speed of 1.01 m/s, but husky reaches at most 1 m/s",
    ),
    (
        "husky",
        "kind: velocity-profile, legs: [{duration: 1s, speed: 20m/s}]",
        "a speed of 20 m/s, .* reaches at most 1 m/s",
    ),
    (
        "husky",
        "kind: velocity-profile, legs: [{duration: 1s, turn_deg_s: -120}]",
        "turn of 120 deg/s, .* 114.592 deg",
    ),
    (
        "iris",
        "kind: way-points, points_m: [[20, 10]], speed: 12.5m/s",
        "a speed of 12.5 m/s, .* reaches at most 12 m/s",
    ),
    (
        "iris",
        "kind: way-points, points_m: [[11, 10, 90]], speed: 4m/s",
        "a climb rate of 3.91.* m/s, .* at most 3 m/s",
    ),
    ("iris", "kind: velocity-profile, legs: [{duration: 1s, climb_m_s: -2}]", "a sink rate of 2 m/s, .* 1.5 m/s"),
    (
        "husky",
        "kind: velocity-profile, legs: [{duration: 1s, climb_m_s: 0.1}]",
        "climb rate of 0.1 m/s, .* at most 0 m/s",
    ),
    ("iris", "kind: velocity-profile, legs: [{duration: 1s, turn_deg_s: -5}]", "turn of 5 deg/s, .* at most 0 deg/s"),
]


@pytest.mark.parametrize(("robot", "motion", "message"), TOO_FAST)
def test_a_motion_beyond_the_limits_is_refused_and_not_clipped(
    robot: str, motion: str, message: str, tmp_path: Path
) -> None:
    text = SCENARIO.replace(
        "robot: cart, at_m: [30, 10]", f"robot: {robot}, at_m: [30, 10],\n    motion: {{{motion}}}"
    )
    error = loading_error(text, tmp_path)
    assert re.search(f"three has .*{message}", error.what), error.what
    assert error.where.endswith(":17"), error.where
    assert error.remedy == f"choose a lower value, or a robot that is faster than {robot}"


def test_a_motion_at_the_limits_is_accepted(tmp_path: Path) -> None:
    motion = "kind: way-points, points_m: [[20, 10]], speed: 1m/s"
    text = SCENARIO.replace("robot: cart, at_m: [30, 10]", f"robot: husky, at_m: [30, 10], motion: {{{motion}}}")
    build(load_scenario(write_scenario(text, tmp_path)))


def test_a_scenario_of_the_lab_has_priority_over_a_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenarios").mkdir()
    text = SCENARIO.replace("name: meadow", "name: baylands")
    (tmp_path / "scenarios" / "baylands.yaml").write_text(text, encoding="utf-8")
    assert load_scenario("baylands").summary == "for tests"
    (tmp_path / "scenarios" / "meadow.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="name is 'baylands', but the file name is 'meadow'"):
        load_scenario("meadow")


def test_values_are_changed_by_their_keys() -> None:
    scenario = load_scenario("baylands", {"agents.husky-2.along": "40m", "traffic.0.size_bytes": 64, "line": "nlos"})
    assert (scenario.agents["husky-2"].along, scenario.traffic[0].size_bytes, scenario.line) == (40, 64, "nlos")
    assert load_scenario("baylands", {"physics.step": "2ms", "policy.window": "4ms"}).physics.step_ns == 2_000_000
    for key in ("traffic.9.rate", "traffic.x.rate", "name.x", "traffic.0.kind.x.y"):
        with pytest.raises(ConfigurationError, match=f"with {key}=1: the key {key} cannot be changed"):
            load_scenario("baylands", {key: 1})
    with pytest.raises(ConfigurationError, match=r"baylands.yaml:\d+ with policy.name=x: .*no sync policy 'x'"):
        load_scenario("baylands", {"policy.name": "x"})


def test_a_run_that_needs_too_much_memory_is_refused_with_both_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:  8 kB\nMemAvailable:    1000 kB\n", encoding="ascii")
    monkeypatch.setattr(checks, "MEMINFO", meminfo)
    # 10 Hz for 2 s and a bag of 100 packets are 120 packets of 1200 bytes; 2000 windows and 10 per packet have 40
    # bytes each; and there are three pairs of agents.
    assert checks.needed_bytes(load_scenario(write_scenario(SCENARIO, tmp_path))) == 120 * 1200 + 3200 * 40 + 3 * 1600
    error = loading_error(SCENARIO.replace("rate: 10Hz", "rate: 1kHz"), tmp_path)
    assert "2 s of 3 agents would need 3.4 MB of memory, but only 1.0 MB are available" in error.what
    assert "choose a shorter duration, or send less: one-stream alone has 2,000 packets" in error.remedy
    assert error.where.endswith(":4")
    monkeypatch.setattr(checks, "MEMINFO", tmp_path / "none")
    assert checks.available_bytes() is None


def test_too_many_agents_for_the_memory_are_refused_before_they_are_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, _, remaining_text = SCENARIO.partition("  one: ")
    agents = "".join(f"  n{number}: {{robot: turtlebot3_burger, at_m: [0, 0]}}\n" for number in range(300))
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemAvailable:    70200 kB\n", encoding="ascii")
    monkeypatch.setattr(checks, "MEMINFO", meminfo)
    # 44,850 pairs need 72 MB. If the bodies were built, the error would be that all have one position.
    error = loading_error(f"{text}{agents}  one: {remaining_text}", tmp_path)
    assert "2 s of 303 agents would need 73 MB of memory, but only 72 MB are available" in error.what
    assert error.where.endswith(":7")
    assert error.remedy == "use fewer agents"


def write_scenario(text: str, folder: Path) -> Path:
    path = folder / "meadow.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("0", "unknown key 0"),
        ("agents.0", "0"),
        ("traffic.9", "traffic.9 cannot be changed"),
        ("traffic." + "9" * 5000, "cannot be changed"),
        ("traffic.x.rate", "traffic.x.rate cannot be changed"),
        ("name.x", "name.x cannot be changed"),
    ],
)
def test_a_key_that_does_not_exist_cannot_be_changed(tmp_path: Path, key: str, message: str) -> None:
    path = tmp_path / "meadow.yaml"
    path.write_text(SCENARIO.replace("robot: cart", "robot: turtlebot3_burger"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        load_scenario(path, {key: 1})
