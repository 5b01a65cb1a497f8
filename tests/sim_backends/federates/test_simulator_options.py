"""Options of simulators in a scenario: an error has file and line, and a simulator receives all options."""

import json
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.emane_events.options import EmaneOptions
from sim_backends.federates.frames import NETWORK, PHYSICS
from sim_backends.federates.simulator_options import SimulatorOptions
from sim_backends.world.world import load_world

SCENARIO = """\
name: pair
summary: two robots
world: open
duration: 1s
physics:
  federate: PHYSICS
  options:
    VALUE
network: {federate: NETWORK, options: {ampdu_bytes: 100}}
agents:
  ann: {robot: husky, at_m: [0, 0]}
  bob: {robot: husky, at_m: [10, 0]}
"""


def load_changed(
    folder: Path, value: str = "reset: false", physics: str = "gazebo", network: str = "ns3", **changes: object
) -> CosimScenario:
    path = folder / "pair.yaml"
    text = SCENARIO.replace("PHYSICS", physics).replace("NETWORK", network).replace("VALUE", value)
    path.write_text(text, encoding="utf-8")
    return load_scenario(path, {key.replace("__", "."): value for key, value in changes.items()})


def sent_options(scenario: CosimScenario, role: int) -> dict[str, object]:
    world = load_world(scenario.world)
    hello = make_hello(scenario, world, make_bodies(scenario, world), 1, role)
    options: dict[str, object] = json.loads(hello.configuration)["options"]
    return options


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("reste: true", "in physics.options: unknown key reste; did you mean 'reset'?"),
        ("speed: 1", "unknown key speed; valid keys: world, models, origins_m"),
        ("acknowledge: of", "'of' is not one of: auto, required, off; did you mean 'off'?"),
        ("timeout_s: 0", "in physics.options.timeout_s: Input should be greater than 0"),
        ("settle_s: 1s", "'1s' is not a number; write it without a unit"),
        ("models: {anne: husky}", "there is no agent 'anne'; did you mean 'ann'?"),
        ("origins_m: {ann: [0, 0]}", "in physics.options.origins_m.ann: this list needs more values"),
    ],
)
def test_a_wrong_option_has_its_line_and_a_remedy(value: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        load_changed(tmp_path, value)
    assert message in error_info.value.what
    assert error_info.value.where == f"{tmp_path / 'pair.yaml'}:8"


def test_an_option_of_the_command_line_is_validated_too(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationError, match=r"in network.options.standard: '802.11ax' is not one of: 802.11a"
    ) as error_info:
        load_changed(tmp_path, network__options__standard="802.11ax")
    assert "correct the option with this value" in error_info.value.remedy
    with pytest.raises(ConfigurationError, match="gazebo is a physics federate, not a network federate"):
        load_changed(tmp_path, network__federate="gazebo")
    with pytest.raises(ConfigurationError, match="unknown key gravity; no keys are valid here"):
        load_changed(tmp_path, physics__federate="mujoco", physics__options={"gravity": 1})


def test_a_simulator_receives_all_options(tmp_path: Path) -> None:
    scenario = load_changed(tmp_path, "limit_m_s2: 3")
    physics_options = sent_options(scenario, PHYSICS)
    assert (physics_options["limit_m_s2"], physics_options["settle_s"], physics_options["acknowledge"]) == (
        3,
        0.5,
        "auto",
    )
    assert "world" not in physics_options
    assert sent_options(scenario, NETWORK) == {"ampdu_bytes": 100}
    assert sent_options(load_changed(tmp_path, network__options=None), NETWORK) == {"ampdu_bytes": 0}
    emane = load_scenario("convoy", {"physics.federate": "emane", "physics.options": {"nems": {"leader": 7}}})
    assert EmaneOptions.model_validate(sent_options(emane, PHYSICS)) == emane.physics.options


def test_a_command_and_an_address_have_any_options(tmp_path: Path) -> None:
    scenario = load_changed(tmp_path, "speed: [1, {x: y}]", "./carts", "tcp:127.0.0.1:7000")
    assert sent_options(scenario, PHYSICS) == {"speed": [1, {"x": "y"}]}
    assert not isinstance(scenario.network.options, SimulatorOptions)


def test_a_simulator_does_not_receive_the_options_of_the_simulator_that_it_replaces(tmp_path: Path) -> None:
    scenario = load_changed(tmp_path, physics__federate="mujoco", network__federate="builtin")
    assert sent_options(scenario, PHYSICS) == {}
    assert scenario.network.options is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "traffic: [{kind: stream, from: ann, to: bob, rate: 10Hz, protocol: topic}]",
            "ns-3 has no topics; set network.transports: builtin, or network.options.topics: udp",
        ),
        (
            "traffic: [{kind: stream, from: ann, to: bob, rate: 10Hz, protocol: ros1}]\nrelay: ann",
            "ns-3 has no ROS 1; set network.transports: builtin",
        ),
        (
            "traffic: [{kind: stream, from: ann, to: bob, rate: 10Hz, protocol: ros1-udp}]\nrelay: ann",
            "ns-3 has no ROS 1; set network.transports: builtin",
        ),
    ],
)
def test_an_unsupported_protocol_is_an_error_with_its_line(line: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "pair.yaml"
    path.write_text(SCENARIO.replace("PHYSICS", "gazebo").replace("VALUE", "{}") + line + "\n", encoding="utf-8")
    changes = {"physics.options": None, "network.federate": "ns3"}
    with pytest.raises(ConfigurationError, match=message) as error_info:
        load_scenario(path, changes)
    assert error_info.value.where.startswith(f"{path}:13")
    load_scenario(path, changes | {"network.federate": "builtin", "network.options": None})
    load_scenario(path, changes | {"network.transports": "builtin"})


NETWORK_ONLY = """\
name: pair
summary: two robots
world: open
duration: 1s
network: {federate: ns3, KEYS}
radio: {RADIO}
agents: {ann: {robot: husky, at_m: [0, 0]}}
"""


@pytest.mark.parametrize(
    ("radio", "keys", "message"),
    [
        ("loss: 1%", "options: {standard: 802.11a}", "fixed links have no Wi-Fi; remove standard"),
        ("delay: 1ms", "options: {ampdu_bytes: 100}", "fixed links have no Wi-Fi; remove ampdu_bytes"),
        ("rate: 1Mbit/s", "options: {pcap: air-}", "fixed links have no Wi-Fi; remove pcap"),
        ("", "options: {topics: udp}, transports: builtin", "transports: builtin carries all topics; remove topics"),
    ],
)
def test_options_of_ns3_without_an_effect_are_refused_with_their_line(
    radio: str, keys: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "pair.yaml"
    path.write_text(NETWORK_ONLY.replace("KEYS", keys).replace("RADIO", radio), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message) as error_info:
        load_scenario(path)
    assert error_info.value.where == f"{path}:5"


def test_reliable_topics_over_ns3_are_refused_with_their_line(tmp_path: Path) -> None:
    topic_traffic = {"kind": "stream", "from": "ann", "to": "bob", "rate": "10Hz", "protocol": "topic"}
    best_effort = topic_traffic | {"qos": {"reliability": "best_effort"}}
    load_changed(tmp_path, traffic=[best_effort], network__options__topics="udp")
    for traffic in (topic_traffic, topic_traffic | {"qos": {"reliability": "reliable"}}):
        with pytest.raises(ConfigurationError, match="no reliable topics; set reliability: best_effort"):
            load_changed(tmp_path, traffic=[best_effort, traffic], network__options__topics="udp")
