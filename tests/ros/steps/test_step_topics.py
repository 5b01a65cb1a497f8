"""The step `topics`: valid keys, arguments of the agents, and trials over radios that lose packets."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from fieldkit.agent.messaging import ros1
from fieldkit.agent.messaging.middleware import Network, Topic
from fieldkit.agent.messaging.stream import MIN_BYTES, Stream
from fieldkit.cli import main
from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.measure.captures import pcap
from fieldkit.remote import agent
from fieldkit.ros.middlewares import ports
from fieldkit.ros.steps.topics import TopicsStep
from fieldkit.ros.streams import stream_options
from fieldkit.steps.kinds.capture import CaptureStep
from fieldkit.steps.scene import CommandResult, Scene
from fieldkit.trial.procedure import Procedure
from tests.helpers import texts
from tests.helpers.casts import CAST
from tests.helpers.paths import ROOT

SCENE = Scene(Protocol.UDP, CAST, ".fieldkit/t/a")


def topics(keys: str = "over: dds") -> TopicsStep:
    text = f"{{from: sender, to: receiver, {keys}}}"
    return schema.validate(schema.parse(text, source="x.yaml"), TopicsStep)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("over: dds, discovery: router", "dds cannot use router; use multicast or peers"),
        ("over: ros1, discovery: multicast", "ros1 cannot use multicast; use master"),
        ("over: ros2, discovery: router", "ros2 cannot use router; use environment or multicast or peers"),
        ("over: ros2, settings: {'General/x': '1'}", "environment variables, not 'General/x'"),
        ("over: ros2, settings: {ROS_DOMAIN_ID: '1'}", "ROS_DOMAIN_ID is set by the key domain"),
        ("over: dds, transport: udp", "only zenoh has a choice of transport"),
        ("over: ros1, qos: {reliability: best_effort}", "ROS 1 sends by TCP"),
        ("over: ros1, qos: {profile: sensor_data}", "ROS 1 sends by TCP"),
        ("rate: 1Hz, duration: 500ms", "ends before its second sample"),
        ("bytes: 23B", "greater than or equal to 24"),
        ("domain: 102", "less than or equal to 101"),
        ("qos: {profile: sensor}", "ROS 2 has no profile 'sensor'; there are default, sensor_data"),
        ("settings: {'Discovery/<x>': '1'}", "match pattern"),
        ("settings: tunde", "settings must be default, tuned, or"),
        ("topic: /a//b", "is not the name of a topic"),
    ],
)
def test_invalid_keys_are_rejected_with_their_line(keys: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as failed:
        topics(keys)
    assert failed.value.where.startswith("x.yaml:1") or "x.yaml:1" in str(failed.value)


def test_equal_sender_and_receiver_are_rejected() -> None:
    with pytest.raises(ConfigurationError, match="cannot send to itself"):
        schema.validate(schema.parse("{from: sender, to: sender}", source="x.yaml"), TopicsStep)


def test_subscriber_and_publisher_get_their_arguments() -> None:
    subscribe, publish = topics("name: a, bytes: 500B, rate: 20Hz, qos: {profile: sensor_data}").jobs(SCENE)
    command_start = (
        "bash",
        "-c",
        '. /opt/ros/noetic/setup.bash && exec "$@"',
        "bash",
        "python3",
        agent.path_from_job(),
    )
    for planned, verb, role in ((subscribe, "subscribe", Role.RECEIVER), (publish, "publish", Role.SENDER)):
        assert (planned.role, planned.program, planned.job.name) == (role, "python3", f"a.{verb}")
        assert planned.job.argv[:6] == command_start
        assert planned.job.argv[6] == verb
        assert planned.job.argv[8] == f"a.{role}-topic.bin"
        argument = json.loads(planned.job.argv[7])
        network, topic = Network(**argument["network"]), Topic.from_json(argument["topic"])
        assert (network.address, network.node) == (CAST[role].address, f"fieldkit_{role}")
        assert (topic.dds_topic, topic.quality.reliability) == ("rt/fieldkit/stream", "best_effort")
        assert Stream(**argument["stream"]) == Stream("dds", 500, 20.0, 10.0, 20.0)
    assert subscribe.job.ready == "log:up,"
    assert publish.job.limit_s < subscribe.job.limit_s


def test_router_or_master_starts_first() -> None:
    serve, *_ = topics("over: zenoh, discovery: router").jobs(SCENE)
    assert (serve.role, serve.job.argv[6]) == (Role.RELAY, "route")
    master, subscribe, _ = topics("over: ros1").jobs(SCENE)
    relay = CAST[Role.RELAY].address
    words = ("env", f"ROS_IP={relay}", f"ROS_HOSTNAME={relay}", "rosmaster", "--core", "-p", "11626")
    assert master.job.argv[4:] == words
    assert json.loads(subscribe.job.argv[7])["network"]["server"] == relay


def test_capture_filter_includes_multicast() -> None:
    text = "{robots: [sender], during: [topics: {from: sender, to: receiver, over: zenoh}]}"
    capture, *_ = schema.validate(schema.parse(text, source="x"), CaptureStep).jobs(SCENE)
    sender, receiver = (CAST[role].address for role in (Role.SENDER, Role.RECEIVER))
    assert capture.job.argv[-1] == (
        f"((host {sender} and host {receiver}) or (src host {receiver} and dst host 224.0.0.224) or "
        f"(src host {sender} and dst host 224.0.0.224)) and "
        f"(port 7446 or port {ports.zenoh_listener(42)} or icmp or ip[6:2] & 0x1fff != 0)"
    )


def test_the_ports_of_dds_are_those_of_rtps() -> None:
    """The ports are those of RTPS 2.5, table 9.8, for participants 0 and 1 of domain 1."""
    dds_ports = ports.dds(1, multicast=True)
    assert {7650, 7660, 7662} <= dds_ports.discovery
    assert {7651, 7661, 7663} <= dds_ports.data
    assert max(ports.dds(ports.MAX_DOMAIN, multicast=True).data) < 32_768


def test_constants_of_laptop_and_agent_are_equal() -> None:
    assert stream_options.MIN_BYTES == MIN_BYTES
    assert set(ports.ros1_node(0)) == set(ros1.PORTS)


def test_ports_of_domains_are_disjoint() -> None:
    """The ports of Zenoh and ROS 1 in each domain differ from each other and from the default ports."""
    all_ports = [7446, 7447, 11311]
    for domain in range(ports.MAX_DOMAIN + 1):
        all_ports += [
            *ports.zenoh(domain, multicast=False).data,
            *ports.ros1(domain).data,
            *ports.ros1(domain).discovery,
        ]
    assert len(set(all_ports)) == len(all_ports)
    assert max(all_ports) < 32_768


def settings(keys: str) -> dict[str, str]:
    *_, publish = topics(keys).jobs(SCENE)
    values: dict[str, str] = json.loads(publish.job.argv[7])["network"]["settings"]
    return values


@pytest.mark.parametrize("keys", ["over: dds", "over: zenoh", "over: zenoh, transport: udp", "over: ros1"])
def test_tuned_settings_are_added_to_required_ones(keys: str) -> None:
    default_settings, tuned = settings(keys), settings(f"{keys}, settings: tuned")
    assert settings(f"{keys}, settings: default") == default_settings
    assert default_settings.items() <= tuned.items()
    assert default_settings != tuned


def test_tuned_datagram_fits_into_one_packet() -> None:
    """A datagram with IP and UDP headers has at most 1,500 bytes, and contains a DDS fragment with its header."""
    max_bytes = 1500 - 20 - 8
    dds = {name: int(value.removesuffix(" B")) for name, value in settings("over: dds, settings: tuned").items()}
    assert dds["General/FragmentSize"] < dds["General/MaxMessageSize"] <= max_bytes
    udp = settings("over: zenoh, transport: udp, settings: tuned")
    assert int(udp["transport/link/tx/batch_size"]) <= max_bytes


def ros2(keys: str) -> tuple[str, ...]:
    *_, publish = topics(f"over: ros2, {keys}").jobs(SCENE)
    return publish.job.argv


def test_ros_2_runs_with_environment_of_robot_and_settings() -> None:
    sender = CAST[Role.SENDER]
    assert sender.profile.ros is not None
    ros = sender.profile.ros.model_copy(update={"environment": {"RMW_IMPLEMENTATION": "rmw_a", "A": "b c"}})
    robot = sender.model_copy(update={"profile": sender.profile.model_copy(update={"ros": ros})})
    scene = Scene(Protocol.UDP, {**CAST, Role.SENDER: robot}, ".fieldkit/t/a")
    step = topics("over: ros2, discovery: peers, settings: {RMW_IMPLEMENTATION: rmw_b}")
    need, _ = step.needs(scene)
    *_, publish = step.jobs(scene)
    for words in (need.argv, publish.job.argv):
        assert words[4:8] == ("env", "RMW_IMPLEMENTATION=rmw_b", "A=b c", "python3")
    network = json.loads(publish.job.argv[10])["network"]
    assert (network["discovery"], network["peers"]) == ("peers", [CAST[Role.RECEIVER].address])
    assert (network["domain"], network["settings"]) == (42, {})
    assert need.judge(CommandResult("rmw_b", 0)) == (Verdict.OK, "rclpy, rmw_b", "")


def together(*stream_keys: str, within: str = "together") -> str:
    steps = "".join(f"          - topics: {{name: s{number}, {keys}}}\n" for number, keys in enumerate(stream_keys))
    return (
        "name: x\nsummary: x\nscenario: los\ntopology: master\nprotocols: [udp]\nrepeats: 1\n"
        f"steps:\n  - capture:\n      during:\n      - {within}:\n          during:\n{steps}"
    )


@pytest.mark.parametrize("middleware_name", ["zenoh", "zenoh, discovery: router", "ros1"])
def test_simultaneous_streams_need_different_domains(middleware_name: str) -> None:
    """In one domain, the streams would listen on the same ports of the receiver, the router or the master."""
    keys = (
        f"from: sender, to: receiver, over: {middleware_name}",
        f"from: relay, to: receiver, over: {middleware_name}, topic: /b",
    )
    with pytest.raises(
        ConfigurationError, match=r"is used twice at the same time on .*; change the domain of one of them"
    ):
        schema.validate(schema.parse(together(*keys), source="x.yaml"), Procedure)
    schema.validate(schema.parse(together(keys[0], f"{keys[1]}, domain: 7"), source="x.yaml"), Procedure)


def test_streams_of_dds_may_share_a_domain_but_not_a_pair_in_a_capture() -> None:
    keys = "from: sender, to: receiver"
    schema.validate(schema.parse(together(keys, "from: relay, to: receiver"), source="x.yaml"), Procedure)
    schema.validate(schema.parse(together(keys, f"{keys}, domain: 7"), source="x.yaml"), Procedure)
    with pytest.raises(ConfigurationError, match=r"is used twice in one capture.*; change the domain of one of them"):
        schema.validate(schema.parse(together(keys, f"{keys}, topic: /b"), source="x.yaml"), Procedure)


@pytest.mark.parametrize(
    ("middleware_name", "remedy"),
    [
        ("dds", "pip install cyclonedds"),
        ("zenoh", "pip install eclipse-zenoh"),
        ("ros1", "python3-rospy"),
        ("ros2", "setup files"),
    ],
)
def test_missing_middleware_fails_with_remedy(middleware_name: str, remedy: str) -> None:
    step = topics(f"over: {middleware_name}")
    needs = list(step.needs(SCENE))
    assert [need.role for need in needs] == [Role.SENDER, Role.RECEIVER]
    verdict, detail, remedy_text = needs[0].judge(
        CommandResult("Traceback\nModuleNotFoundError: No module named 'x'", 1)
    )
    assert (verdict, detail) == (Verdict.FAIL, "ModuleNotFoundError: No module named 'x'")
    assert remedy in remedy_text
    assert needs[0].judge(CommandResult("", 0))[0] is Verdict.OK


PROCEDURE = texts.procedure(
    "lossy",
    """\
- capture:
    during:
      - topics: {topics}
""",
    topology="{topology}",
    protocols="udp",
)
SITE = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  turtlebot-2: {profile: turtlebot3_burger}
  duckiedrone-1: {profile: duckiedrone}
roles:
  masterless: {sender: turtlebot-1, receiver: turtlebot-2}
  master: {sender: turtlebot-1, receiver: turtlebot-2, relay: duckiedrone-1}
emulated: {ros: builtin, late_bound: 2s, radio: {loss: LOSS}}
"""


def trial(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: str,
    *,
    loss: str,
    topology: str = "masterless",
    extra_keys: str = "",
) -> Path:
    """Run a trial of one repeat; return its folder."""
    text = PROCEDURE.format(topology=topology, topics=f"{{from: sender, to: receiver, {keys}}}")
    return run_procedure(folder, monkeypatch, text + extra_keys, SITE.replace("LOSS", loss))


def run_procedure(folder: Path, monkeypatch: pytest.MonkeyPatch, procedure: str, site: str) -> Path:
    """Run a trial of a procedure of one repeat; return its folder."""
    (folder / "procedures").mkdir()
    (folder / "procedures" / "lossy.yaml").write_text(procedure, encoding="utf-8")
    (folder / "fieldkit.yaml").write_text(site, encoding="utf-8")
    monkeypatch.chdir(folder)
    assert main(["trial", "lossy", "5m", "--yes"]) == 0
    (trial_folder,) = (folder / "trials").iterdir()
    return trial_folder


def row(folder: Path) -> dict[str, str]:
    (values,) = csv.DictReader((folder / "trial.csv").open(encoding="utf-8"))
    return values


@pytest.mark.emulated
def test_losses_equal_those_of_the_radio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With best effort and one frame per sample, the lost samples are the lost packets of the radio."""
    size = 600
    keys = f"rate: 200Hz, bytes: {size}B, duration: 2s, patience: 60s, qos: {{profile: sensor_data, depth: 1000}}"
    folder = trial(tmp_path, monkeypatch, keys, loss="20%")
    row_values = row(folder)
    counts = []
    for role in ("sender", "receiver"):
        packets = pcap.read(folder / "repeats" / "udp-01" / f"{role}.pcap").packets
        from_sender = np.isin(packets.dport, list(ports.dds(42, multicast=True).data)) & (packets.udp_bytes > size)
        counts.append(int(from_sender.sum()))
    sent, received = counts
    assert (int(row_values["topic_sent"]), int(row_values["topic_received"])) == (sent, received)
    assert sent > received
    # If the subscriber discovers the publisher after the publisher has discovered it, it accepts no earlier samples.
    assert float(row_values["topic_loss"]) == pytest.approx(0.2, abs=0.15)


@pytest.mark.emulated
def test_a_repeat_without_discovery_is_valid_and_has_no_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row_values = row(trial(tmp_path, monkeypatch, "duration: 1s, patience: 1s", loss="100%"))
    assert (row_values["status"], row_values["topic_discovered"], row_values["topic_sent"]) == ("valid", "false", "0")
    assert row_values["topic_loss"] == ""
    assert int(row_values["topic_discovery_packets"]) > 0


@pytest.mark.emulated
def test_samples_arrive_with_a_router_a_master_and_several_publishers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several robots publish simultaneously to one robot; over Zenoh and ROS 1, each stream has a separate domain."""
    # A subscriber that pauses on a busy machine loses no samples.
    common = "duration: 1s, patience: 60s, qos: {depth: 1000}"
    zenoh = f"        - topics: {{name: z, from: sender, to: receiver, over: zenoh, discovery: router, {common}}}\n"
    stream_keys = [
        f"{{name: {over}{number}, from: {role}, to: receiver, over: {over}, domain: {number}, server: receiver, "
        f"rate: 20Hz, {common}}}"
        for over in ("zenoh", "ros1")
        for number, role in enumerate(("sender", "relay"), start=1)
    ]
    text = "".join(f"        - topics: {keys}\n" for keys in stream_keys)
    extra_keys = f"{zenoh}  - together:\n      during:\n{text}"
    ros1 = f"over: ros1, rate: 50Hz, {common}"
    row_values = row(trial(tmp_path, monkeypatch, ros1, loss="0%", topology="master", extra_keys=extra_keys))
    for name in ("", "z.", "zenoh1.", "zenoh2.", "ros11.", "ros12."):
        assert row_values[f"{name}topic_sent"] == row_values[f"{name}topic_received"] != "0"
    for name in ("", "z."):
        assert int(row_values[f"{name}topic_data_packets"]) > int(row_values[f"{name}topic_sent"])


@pytest.mark.emulated
def test_samples_arrive_between_robots_with_ros_2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two streams use Fast DDS: one with the discovery of the environment (multicast), and one with peers."""
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    python = f"  ping: ping\n  python: {ROOT / '.ros2' / 'bin' / 'python'}"
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "real.yaml").write_text(
        profile.replace("name: turtlebot3_burger", "name: real").replace("  ping: ping", python), encoding="utf-8"
    )
    keys = "from: sender, to: receiver, over: ros2, rate: 20Hz, duration: 1s, patience: 60s, qos: {depth: 1000}"
    procedure = together(keys, f"{keys}, domain: 7, discovery: peers").replace("name: x", "name: lossy")
    site = SITE.replace("profile: turtlebot3_burger", "profile: real").replace("LOSS", "0%")
    folder = run_procedure(tmp_path, monkeypatch, procedure, site)
    row_values = row(folder)
    assert row_values["status"] == "valid"
    packets = pcap.read(folder / "repeats" / "udp-01" / "sender.pcap").packets
    for name, domain, uses_multicast in (("s0", 42, True), ("s1", 7, False)):
        assert row_values[f"{name}.topic_sent"] == row_values[f"{name}.topic_received"] != "0"
        sent = int(row_values[f"{name}.topic_sent"])
        # There is one packet per sample, and there are some for heartbeats and for the participants of each node.
        assert sent <= int(row_values[f"{name}.topic_data_packets"]) < 200
        assert sent * 1_000 <= int(row_values[f"{name}.topic_data_bytes"]) < 2 * 20 * 1_000
        assert int(row_values[f"{name}.topic_discovery_packets"]) > 0
        assert 0 < float(row_values[f"{name}.topic_discovery_s"]) < 60
        assert row_values[f"{name}.topic_packet_loss"] == "0"
        multicast = packets.are_to("239.255.0.1") & np.isin(
            packets.dport, list(ports.dds(domain, multicast=True).discovery)
        )
        assert multicast.any() == uses_multicast
