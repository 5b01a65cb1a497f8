"""Expected command lines for each variant of a tool, and refusals before the first repeat."""

from collections.abc import Mapping
from dataclasses import replace

import pytest

from fieldkit.cli.dry_run import print_commands, shell_line
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.model import Protocol, RepeatId, Role
from fieldkit.steps import variants
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.scene import Refusal
from fieldkit.steps.variants import Netcat, PingTool, Recorder, Variants
from fieldkit.trial import planned_evidence
from fieldkit.trial.check import tools
from fieldkit.trial.plan import Plan
from tests.helpers.casts import TURTLEBOT, los_plan, ros_of
from tests.helpers.paths import DATA
from tests.helpers.plans import steps_of

DEFAULT = variants.expected(TURTLEBOT)
ENDLESS = """sh -c 'mkfifo .endless && exec <>.endless && rm .endless && exec "$@"' sh """

LISTEN = {
    (Netcat.TRADITIONAL, Protocol.TCP): "nc.traditional -l -p 1234",
    (Netcat.TRADITIONAL, Protocol.UDP): "nc.traditional -u -l -p 1234 -w 2",
    (Netcat.OPENBSD, Protocol.TCP): "nc.traditional -l 1234",
    (Netcat.OPENBSD, Protocol.UDP): "nc.traditional -u -w 2 -l 1234",
    (Netcat.NCAT, Protocol.TCP): f"{ENDLESS}nc.traditional --recv-only -l 1234",
    (Netcat.NCAT, Protocol.UDP): "nc.traditional -u --recv-only -i 2 -l 1234",
    (Netcat.BUSYBOX, Protocol.TCP): f"{ENDLESS}nc.traditional -l -p 1234",
}
SEND = {
    (Netcat.TRADITIONAL, Protocol.TCP): "nc.traditional -q 0 10.42.0.2 1234",
    (Netcat.TRADITIONAL, Protocol.UDP): "nc.traditional -u -q 0 10.42.0.2 1234",
    (Netcat.OPENBSD, Protocol.TCP): "nc.traditional -q 0 10.42.0.2 1234",
    (Netcat.OPENBSD, Protocol.UDP): "nc.traditional -u -q 0 10.42.0.2 1234",
    (Netcat.NCAT, Protocol.TCP): "nc.traditional --send-only 10.42.0.2 1234",
    (Netcat.NCAT, Protocol.UDP): "nc.traditional -u --send-only 10.42.0.2 1234",
    (Netcat.BUSYBOX, Protocol.TCP): "nc.traditional 10.42.0.2 1234",
}
PING = "-c 10 -i 0.2 -s 502 -W 2 10.42.0.2 > ping.txt 2> sender-ping.log"


def lines(protocol: Protocol, detected: Mapping[Role, Variants], plan: Plan | None = None) -> dict[str, str]:
    """Return the command line of each job with these tools by job name; `capture` is the receiver's."""
    plan = plan or los_plan()
    scene = plan.scene(RepeatId(protocol, 1), "f", detected)
    jobs = [planned.job for entry in plan.procedure.steps for planned in entry.step.jobs(scene)]
    return {job.name: shell_line(job) for job in jobs}


def on_both(**changes: object) -> dict[Role, Variants]:
    """Return the default tools with these changes, for sender and receiver."""
    return dict.fromkeys((Role.SENDER, Role.RECEIVER), replace(DEFAULT, **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(("netcat", "protocol"), LISTEN)
def test_transfer_with_each_netcat(netcat: Netcat, protocol: Protocol) -> None:
    command_lines = lines(protocol, on_both(netcat=netcat))
    assert command_lines["listen"] == f"{LISTEN[netcat, protocol]} > recv.bag 2> receiver-listen.log"
    assert command_lines["send"] == f"{SEND[netcat, protocol]} < scan.bag 2> sender-send.log"


def test_each_end_uses_options_of_its_netcat() -> None:
    detected = {
        Role.SENDER: replace(DEFAULT, netcat=Netcat.NCAT),
        Role.RECEIVER: replace(DEFAULT, netcat=Netcat.OPENBSD),
    }
    command_lines = lines(Protocol.TCP, detected)
    assert command_lines["listen"].startswith(LISTEN[Netcat.OPENBSD, Protocol.TCP])
    assert command_lines["send"].startswith(SEND[Netcat.NCAT, Protocol.TCP])


def test_ping_with_each_variant() -> None:
    assert lines(Protocol.TCP, on_both())["ping"] == f"env LC_ALL=C ping -n -D {PING}"
    assert lines(Protocol.TCP, on_both(ping=PingTool.IPUTILS_OLD))["ping"] == f"env LC_ALL=C ping -n -D {PING}"
    assert lines(Protocol.TCP, on_both(ping=PingTool.BUSYBOX))["ping"] == f"env LC_ALL=C ping {PING}"


def test_old_tcpdump_has_no_immediate_mode() -> None:
    assert lines(Protocol.TCP, on_both(immediate_mode=False))["capture"].startswith(
        "tcpdump -i wlan0 -n -U -s 128 -B 4096 -w receiver.pcap"
    )


def with_recorder(text: str) -> RobotProfile:
    """Return the TurtleBot with ROS 2, from options of its record command and the path that it writes."""
    options, writes = text.split(" > ")
    ros2 = ros_of(TURTLEBOT).variants["ros2"]
    record = (*ros2.record[:3], *options.split(), *ros2.record[3:])
    command = ros2.model_copy(update={"record": record, "writes": writes})
    ros = ros_of(TURTLEBOT).model_copy(update={"variant": "ros2", "variants": {"ros2": command}})
    return TURTLEBOT.model_copy(update={"ros": ros})


def ros2_plan(text: str) -> Plan:
    plan = los_plan()
    cast = {role: member.model_copy(update={"profile": with_recorder(text)}) for role, member in plan.cast.items()}
    return plan.model_copy(update={"cast": cast})


@pytest.mark.parametrize("suffix", ["db3", "mcap"])
def test_file_of_ros2_recorder_is_sent_and_measured(suffix: str) -> None:
    plan = ros2_plan(f"--no-discovery > {{name}}/{{name}}_0.{suffix}")
    assert lines(Protocol.TCP, {}, plan)["send"].endswith(f"< scan/scan_0.{suffix} 2> sender-send.log")
    (transfer,) = planned_evidence.transfers(plan, Protocol.TCP)
    assert transfer.sent_file == f"scan/scan_0.{suffix}"


def test_tools_of_the_paper_are_not_refused() -> None:
    assert los_plan().refusals(on_both()) == ()


def test_busybox_netcat_is_refused_for_udp() -> None:
    refusals = los_plan().refusals(on_both(netcat=Netcat.BUSYBOX))
    assert [(refusal.role, refusal.what) for refusal in refusals] == [
        (Role.SENDER, "busybox nc has no UDP"),
        (Role.RECEIVER, "busybox nc has no UDP"),
    ]
    assert all("apt-get install netcat-traditional" in refusal.remedy for refusal in refusals)
    assert los_plan(protocols=(Protocol.TCP,)).refusals(on_both(netcat=Netcat.BUSYBOX)) == ()


def test_dry_run_shows_refusals(capsys: pytest.CaptureFixture[str]) -> None:
    plan = los_plan()
    receiver = plan.cast[Role.RECEIVER]
    named = receiver.profile.tools.model_copy(update={"netcat": "/opt/busybox"})
    other = receiver.model_copy(update={"profile": receiver.profile.model_copy(update={"tools": named})})
    print_commands(plan.model_copy(update={"cast": plan.cast | {Role.RECEIVER: other}}))
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "refused" in line]
    assert "turtlebot-2" in line
    assert "busybox nc has no UDP" in line


@pytest.mark.parametrize(
    ("sender", "receiver", "roles"),
    [
        (Netcat.OPENBSD, Netcat.TRADITIONAL, [Role.RECEIVER]),
        (Netcat.OPENBSD, Netcat.OPENBSD, []),
        (Netcat.OPENBSD, Netcat.NCAT, [Role.RECEIVER]),
        (Netcat.NCAT, Netcat.TRADITIONAL, []),
        (Netcat.TRADITIONAL, Netcat.NCAT, []),
        (Netcat.TRADITIONAL, Netcat.OPENBSD, []),
        (Netcat.TRADITIONAL, Netcat.BUSYBOX, [Role.RECEIVER]),
        (Netcat.BUSYBOX, Netcat.TRADITIONAL, [Role.SENDER]),
    ],
)
def test_pair_without_udp_is_refused_once(sender: Netcat, receiver: Netcat, roles: list[Role]) -> None:
    detected = {Role.SENDER: replace(DEFAULT, netcat=sender), Role.RECEIVER: replace(DEFAULT, netcat=receiver)}
    assert [refusal.role for refusal in los_plan().refusals(detected)] == roles


@pytest.mark.parametrize(
    ("help_text", "is_refused"),
    [
        ((DATA / "ncat/7.93/about.txt").read_bytes(), False),
        ((DATA / "ncat/7.95/about.txt").read_bytes(), True),
        (b"Ncat: Version 7.93 ( https://nmap.org/ncat )\n", False),
        (b"Ncat: Version 7.94SVN ( https://nmap.org/ncat )\n", True),
        (b"Ncat 7.40 ( https://nmap.org/ncat )\n", False),
        (b"Ncat 8.00 ( https://nmap.org/ncat )\n", True),
        (b"", True),
    ],
    ids=["7.93", "7.95", "version 7.93", "version 7.94SVN", "7.40", "8.00", "unknown"],
)
def test_ncat_that_truncates_datagrams_is_refused(help_text: bytes, is_refused: bool) -> None:
    """The receiver's netcat is identified from its help; without a known version it counts as a new one."""
    output = b"==> user <==\n1000\n\n==> exit 0 <==\n==> netcat <==\n%s\n==> exit 0 <==\n" % help_text
    ncat = tools.parse(output, TURTLEBOT) if help_text else replace(DEFAULT, netcat=Netcat.NCAT)
    detected = {Role.SENDER: replace(DEFAULT, netcat=Netcat.OPENBSD), Role.RECEIVER: ncat}
    refusals = list(los_plan().refusals(detected))
    assert bool(refusals) == is_refused
    assert all("truncates the datagrams of 16384 bytes" in refusal.what for refusal in refusals)
    assert los_plan(protocols=(Protocol.TCP,)).refusals(detected) == ()
    assert los_plan().refusals({Role.SENDER: ncat, Role.RECEIVER: ncat}) == ()
    assert los_plan().refusals({Role.SENDER: ncat, Role.RECEIVER: replace(DEFAULT, netcat=Netcat.OPENBSD)}) == ()


@pytest.mark.parametrize(
    ("changes", "interval_s", "is_refused"),
    [
        ({"ping": PingTool.IPUTILS_OLD}, 0.1, True),
        ({"ping": PingTool.IPUTILS_OLD}, 0.2, False),
        ({"ping": PingTool.IPUTILS_OLD, "root": True}, 0.1, False),
        ({"ping": PingTool.IPUTILS}, 0.1, False),
        ({"ping": PingTool.BUSYBOX}, 0.1, False),
    ],
)
def test_short_interval_of_old_iputils_needs_root(
    changes: dict[str, object], interval_s: float, is_refused: bool
) -> None:
    plan = los_plan()
    (ping,) = steps_of(plan.procedure, PingStep)
    scene = plan.scene(RepeatId(Protocol.TCP, 1), "f", on_both(**changes))
    refusals = list(ping.model_copy(update={"interval": interval_s}).refusals(scene))
    assert [refusal.role for refusal in refusals] == [Role.SENDER] * is_refused
    assert all("an interval of 100 ms" in refusal.what for refusal in refusals)


MCAP = "--storage mcap > {name}/{name}_0.mcap"


@pytest.mark.parametrize(
    ("text", "detected", "message"),
    [
        (MCAP, Recorder.MCAP, None),
        (MCAP, Recorder.NONE, "its record command cannot write ros2-mcap"),
        (
            MCAP,
            Recorder.SQLITE3,
            "its record command writes ros2-sqlite3, but its profile names {name}/{name}_0.mcap",
        ),
    ],
)
def test_recorder_with_wrong_format_is_refused(text: str, detected: Recorder, message: str | None) -> None:
    refusals = ros2_plan(text).refusals(on_both(recorder=detected))
    assert [refusal.what for refusal in refusals] == ([] if message is None else [message])
    assert all(isinstance(item, Refusal) and item.role is Role.SENDER and item.remedy for item in refusals)


@pytest.mark.parametrize(
    ("help_file", "command", "detected"),
    [
        ("eloquent", "--no-discovery", Recorder.SQLITE3),
        ("eloquent", "--storage mcap", Recorder.MCAP),
        ("humble", "--no-discovery", Recorder.SQLITE3),
        ("humble", "--storage mcap", Recorder.MCAP),
        ("jazzy", "--no-discovery", Recorder.MCAP),
        ("jazzy", "--storage sqlite3", Recorder.SQLITE3),
        ("humble", "--storage rosbag_v2", Recorder.NONE),
    ],
)
def test_format_of_ros2_recorder_is_read_from_its_help(help_file: str, command: str, detected: Recorder) -> None:
    help_text = (DATA / "ros2-bag" / help_file / "record-help.txt").read_bytes()
    output = b"==> user <==\n1000\n\n==> exit 0 <==\n==> recorder <==\n%s\n==> exit 0 <==\n" % help_text
    profile = with_recorder(f"{command} > {{name}}/{{name}}_0.db3")
    assert tools.parse(output, profile).recorder is detected


def test_missing_recorder_writes_nothing() -> None:
    output = b"==> user <==\n1000\n\n==> exit 0 <==\n==> recorder <==\nsh: ros2: not found\n\n==> exit 127 <==\n"
    assert tools.parse(output, with_recorder(MCAP)).recorder is Recorder.NONE
