"""Expected command lines of the robots of each profile."""

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.cli.dry_run import shell_line
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.model import Protocol, RepeatId, Role
from fieldkit.remote import jobs
from fieldkit.ros.steps.record import RecordStep
from fieldkit.steps.kinds.capture import CaptureStep
from fieldkit.steps.scene import RecordedFile, Scene
from fieldkit.trial.procedure import Procedure, load_procedure
from tests.helpers.casts import CAST, TURTLEBOT, los_plan, ros_of
from tests.helpers.plans import steps_of

FILTER = "'host 10.42.0.1 and host 10.42.0.2 and (port 1234 or icmp or ip[6:2] & 0x1fff != 0)'"
CAPTURE = "tcpdump -i wlan0 -n -U --immediate-mode -s 128 -B 4096 -w"
ROSBAG = """bash -c '. /opt/ros/noetic/setup.bash && exec "$@"' bash rosbag record --duration=15 -O scan /scan"""

EXPECTED_COMMANDS = {
    Protocol.TCP: [
        (Role.SENDER, f"{ROSBAG} 2> sender-record.log"),
        (Role.SENDER, f"{CAPTURE} sender.pcap {FILTER} 2> sender-capture.log"),
        (Role.RECEIVER, f"{CAPTURE} receiver.pcap {FILTER} 2> receiver-capture.log"),
        (Role.RECEIVER, "nc.traditional -l -p 1234 > recv.bag 2> receiver-listen.log"),
        (Role.SENDER, "nc.traditional -q 0 10.42.0.2 1234 < scan.bag 2> sender-send.log"),
        (
            Role.SENDER,
            "env LC_ALL=C ping -n -D -c 10 -i 0.2 -s 502 -W 2 10.42.0.2 > ping.txt 2> sender-ping.log",
        ),
    ],
    Protocol.UDP: [
        (Role.SENDER, f"{ROSBAG} 2> sender-record.log"),
        (Role.SENDER, f"{CAPTURE} sender.pcap {FILTER} 2> sender-capture.log"),
        (Role.RECEIVER, f"{CAPTURE} receiver.pcap {FILTER} 2> receiver-capture.log"),
        (Role.RECEIVER, "nc.traditional -u -l -p 1234 -w 2 > recv.bag 2> receiver-listen.log"),
        (Role.SENDER, "nc.traditional -u -q 0 10.42.0.2 1234 < scan.bag 2> sender-send.log"),
        (
            Role.SENDER,
            "env LC_ALL=C ping -n -D -c 10 -i 0.2 -s 8192 -W 2 10.42.0.2 > ping.txt 2> sender-ping.log",
        ),
    ],
}


@pytest.mark.parametrize("protocol", Protocol)
def test_the_trial_of_the_paper_has_the_expected_commands(protocol: Protocol) -> None:
    plan = los_plan()
    scene = plan.scene(RepeatId(protocol, 1), ".fieldkit/t/r")
    jobs_planned = [planned for entry in plan.procedure.steps for planned in entry.step.jobs(scene)]
    assert [(planned.role, shell_line(planned.job)) for planned in jobs_planned] == EXPECTED_COMMANDS[protocol]


def test_record_override_changes_only_the_duration() -> None:
    (record,) = steps_of(load_procedure("los").with_record(2.5), RecordStep)
    (planned,) = record.jobs(Scene(Protocol.TCP, CAST, "f"))
    assert "--duration=2.5" in planned.job.argv
    assert list(load_procedure("los").with_record(15.0)) == list(load_procedure("los"))


def test_ros2_recording_ends_by_sigint_at_the_limit() -> None:
    ros2 = TURTLEBOT.model_copy(update={"ros": ros_of(TURTLEBOT).model_copy(update={"variant": "ros2"})})
    cast = {Role.SENDER: Robot(name="a", address="10.42.0.1", profile=ros2)}
    text = "{robot: sender, topics: [/scan, /imu], duration: 15s}"
    record = schema.validate(schema.parse(text, source="x"), RecordStep)
    (planned,) = record.jobs(Scene(Protocol.TCP, cast, "f"))
    assert planned.job.argv[-7:] == ("ros2", "bag", "record", "-o", "scan", "/scan", "/imu")
    assert planned.job.limit_s == 15.0
    assert planned.job.ready == "log:Subscribed to topic", (
        "the start of the recorder is not part of the recording time"
    )
    assert record.bag(cast[Role.SENDER]) == "scan/scan_0.db3"


def test_capture_with_sudo_runs_the_job_as_root() -> None:
    text = schema.dump(TURTLEBOT).replace("capture_right: direct", "capture_right: sudo")
    profile = schema.validate(schema.parse(text, source="x"), RobotProfile)
    cast = {role: robot.model_copy(update={"profile": profile}) for role, robot in CAST.items()}
    (entry,) = [entry for entry in load_procedure("los").steps if entry.kind == "capture"]
    first = next(
        entry.step.jobs(Scene(Protocol.TCP, cast, "f", {Role.SENDER: (RecordedFile(Role.SENDER, "scan.bag", 1e6),)}))
    )
    assert jobs.command("start", first.job)[:4] == ("sudo", "-n", "sh", jobs.SCRIPT_PATH)


def test_a_job_is_started_with_its_limit_port_and_files() -> None:
    scene = los_plan().scene(RepeatId(Protocol.UDP, 1), ".fieldkit/t/udp-01-1")
    jobs_planned = [planned for entry in los_plan().procedure.steps for planned in entry.step.jobs(scene)]
    listen = next(planned.job for planned in jobs_planned if planned.job.name == "listen")
    files = ("/dev/null", "recv.bag", "receiver-listen.log")
    command = ("nc.traditional", "-u", "-l", "-p", "1234", "-w", "2")
    expected = ("sh", jobs.SCRIPT_PATH, "start", ".fieldkit/t/udp-01-1", "listen", "120", "udp:04D2", "8", *files)
    assert jobs.command("start", listen) == (*expected, *command)


def test_written_procedure_is_read_unchanged() -> None:
    procedure = load_procedure("nlos")
    text = schema.dump(procedure)
    assert schema.validate(schema.parse(text, source="x"), Procedure) == procedure


def test_limit_of_capture_exceeds_those_of_steps_inside() -> None:
    text = "during: [{transfer: {from: sender, to: receiver, file: a.bag, limit: 30min}}]"
    step = schema.validate(schema.parse(text, source="x"), CaptureStep)
    first, _, listen, send = step.jobs(
        Scene(Protocol.UDP, CAST, "f", {Role.SENDER: (RecordedFile(Role.SENDER, "a.bag", 1e6),)})
    )
    assert first.job.limit_s > listen.job.limit_s + send.job.limit_s


@pytest.mark.parametrize(
    ("during", "filter_text"),
    [
        ("ping: {from: sender, to: relay}", "host 10.42.0.1 and host 10.42.0.3 and (icmp"),
        (
            "transfer: {from: sender, to: receiver}}, {ping: {from: sender, to: relay}",
            "((host 10.42.0.1 and host 10.42.0.2) or (host 10.42.0.1 and host 10.42.0.3)) and (port 1234 or icmp",
        ),
        (
            "record: {robot: sender, topics: [/scan], duration: 1s}",
            "host 10.42.0.1 and host 10.42.0.2 and (icmp",
        ),
    ],
)
def test_capture_filter_follows_steps_inside(during: str, filter_text: str) -> None:
    step = schema.validate(schema.parse(f"during: [{{{during}}}]", source="x"), CaptureStep)
    recordings = {Role.SENDER: (RecordedFile(Role.SENDER, "scan.bag", 1e6),)}
    first = next(step.jobs(Scene(Protocol.TCP, CAST, "f", recordings)))
    assert first.job.argv[-1] == f"{filter_text} or ip[6:2] & 0x1fff != 0)"
