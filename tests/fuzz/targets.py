"""All fuzz targets: readers of data that a robot or another person sends, with stored real outputs as seeds."""

import io
import math
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.agent.messaging import records
from fieldkit.analysis import duplicates, table_files
from fieldkit.campaign.plan import load_campaign
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.site import load_site
from fieldkit.core import laptop_files
from fieldkit.core.columns import Column
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import FaultKind, Protocol, RepeatId, Role
from fieldkit.measure import robot_clock
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.evidence import (
    clock,
    host,
    iperf3,
    oracle_delays,
    outage,
    ping,
    program_output,
    tcpdump_log,
    terminations,
    track,
)
from fieldkit.measure.evidence.sandbox import ReaderError
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.transfers.clock_offset import Clocks
from fieldkit.motion.logs import tlog, tlog_positions
from fieldkit.remote import archive, fetching, jobs, script
from fieldkit.remote.command import printable
from fieldkit.ros.bags import bag, recorded_topics
from fieldkit.ros.streams import read_checks, sample_reads, topic_captures, topic_checks, topic_columns, topic_samples
from fieldkit.ros.streams.sample_reads import ReadPlan
from fieldkit.ros.streams.topic_captures import CapturedTopic
from fieldkit.ros.streams.topic_checks import TopicPlan
from fieldkit.ros.streams.topic_columns import TopicTraffic
from fieldkit.ros.video import video_checks, video_columns
from fieldkit.ros.video.rtp_packets import RtpPackets
from fieldkit.steps.scene import CommandResult
from fieldkit.steps.view import View
from fieldkit.trial import columns, journal, plan
from fieldkit.trial.check import probe, radio, software, system, tools
from fieldkit.trial.check.report import Report
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.running import locks
from fieldkit.trial.stored import plans, rebuild, verification
from tests.fuzz.federate_targets import federate_targets
from tests.fuzz.harness import Target
from tests.fuzz.motion_targets import motion_targets
from tests.fuzz.mutate import MAX_BYTES
from tests.fuzz.radio_targets import radio_targets
from tests.helpers.casts import CAST, TURTLEBOT, los_plan
from tests.helpers.drones import flight
from tests.helpers.paths import DATA, ROOT
from tests.remote.test_remote_fuzz import AnsweringRobot, entry
from tests.ros.bags.test_measure_bag import write_bag, write_ros2_bag
from tests.ros.bags.test_measure_battery import TOPIC, ros1

TRIALS: Final = DATA / "fieldkit" / "4" / "trials"
LOS: Final = TRIALS / "20261122T013134.573068Z_los_30ft_master"
SELFHEAL: Final = TRIALS / "20261122T011151.376739Z_selfheal_10ft_masterless"

# Messages of the job script about its jobs and its locks (fieldkit/remote/*.sh).
_SCRIPT_REPLIES: Final = (
    b"job.sh: held 12 3588 1795309788 jo@laptop 20261122T013134.573068Z_los_30ft_master\n",
    b"job.sh: aborted 1795309788 jo@laptop 20261122T013134.573068Z_los_30ft_master\n",
    b"job.sh: gone 1795309788 jo@laptop 20261122T013134.573068Z_los_30ft_master\n",
    b"job.sh: no job in .fieldkit/20261122T013134.573068Z_los_30ft_master/udp-01\n",
    b"3f2a 3588 jo@laptop 20261122T013134.573068Z_los_30ft_master\n",
    b".fieldkit/20261122T013134.573068Z_los_30ft_master/udp-01/capture 4711 tcpdump -i wlan0\n",
    b"1795309788.600574839\n",
)


def _stored(*patterns: str, below: Path = DATA) -> tuple[bytes, ...]:
    result = sorted({path for pattern in patterns for path in below.glob(pattern) if path.is_file()})
    assert result, patterns
    return tuple(dict.fromkeys(path.read_bytes() for path in result))


def _stored_attempts(*names: str) -> tuple[bytes, ...]:
    return _stored(*(f"*/repeats/*/{name}" for name in names), below=TRIALS)


def _read_file(read: Callable[[Path], object], name: str, data: bytes, place: Path) -> None:
    (place / name).write_bytes(data)
    read(place / name)


def _read_bag(path: Path) -> None:
    bag.read(path)
    bag.battery_share(path, TOPIC)
    recorded_topics.topic_stats(path)


@cache
def _ros2_files(storage: str) -> dict[str, bytes]:
    """Return the files of a ROS 2 bag that rosbags writes, because no bag of a real recorder is stored."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_ros2_bag(Path(folder, "scan"), storage, {"/scan": 40, "/odom": 3})
        return {file.name: file.read_bytes() for file in path.parent.iterdir()}


@cache
def _battery_bags() -> tuple[bytes, ...]:
    with tempfile.TemporaryDirectory() as folder:
        return (ros1(Path(folder), [0.5, 0.25]).read_bytes(), write_bag(Path(folder, "b"), {"/a": 9}).read_bytes())


def _read_ros2_bag(storage: str, mutated_suffix: str, data: bytes, place: Path) -> None:
    files = _ros2_files(storage)
    for name, content in files.items():
        (place / name).write_bytes(data if name.endswith(mutated_suffix) else content)
    _read_bag(place / f"scan_0.{storage}")


def _parse_capture(data: bytes, _: Path) -> None:
    pcap.parse(data, where="capture")


def _measure_fault(data: bytes, place: Path) -> None:
    for kind in FaultKind:
        for name in (outage.note_file(kind), outage.observed_file(kind)):
            stored_path = next(SELFHEAL.glob(f"repeats/*/{name}"), None)
            (place / name).write_bytes(stored_path.read_bytes() if stored_path is not None else data)
        (place / outage.observed_file(kind)).write_bytes(data)
        for has_evidence in (True, False):
            try:
                outage.measure(kind, outage.read(place, kind) if has_evidence else None)
            finally:
                (place / outage.note_file(kind)).write_bytes(data)


def _judge_sections(data: bytes, _: Path) -> None:
    """Judge a robot with a mutated probe, and with sections that all have the same text."""
    text = data.decode(errors="replace")
    trial_plan, output_text = los_plan(), CommandResult(text.strip("\n"), 0)
    names = ("wifi-info", "wifi-link", "wifi-stations", "wifi-power-save", "interface", "offloads", "control", "disk")
    for sections in (
        probe.parse(text),
        dict.fromkeys((*names, "listeners", "batteries", "tools", "wireless"), output_text),
    ):
        report = Report("robot")
        for role, robot in CAST.items():
            radio.judge(robot, sections, report)
            system.judge(trial_plan, role, sections, report)
            software.judge(trial_plan, role, sections, report)
        assert all(finding.detail.isprintable() for finding in report.findings)


def _probe_seeds() -> tuple[bytes, ...]:
    files = {"interface": "ip/6.1.0/up.txt", "offloads": "ethtool/6.1/tun.txt", "wifi-info": "iw/info-station.txt"}
    files |= {"wifi-link": "iw/link-station.txt", "wifi-power-save": "iw/power-save-on.txt"}
    files |= {"wifi-stations": "iw/stations-ap.txt"}
    disk = b"Filesystem 1024-blocks Used Available Capacity Mounted on\n/dev/sda1 30000000 1000 2000000 5% /\n"
    parts = [b"==> %s: 0 <==\n%s\n" % (name.encode(), (DATA / file).read_bytes()) for name, file in files.items()]
    return (b"".join((*parts, b"==> disk: 0 <==\n", disk, b"==> batteries: 0 <==\nBAT0 80\n")),)


def _parse_tools(data: bytes, _: Path) -> None:
    for output in (data, b"==> user <==\n0\n==> exit 0 <==\n" + data):
        tools.parse(output, TURTLEBOT)


def _tool_seeds() -> tuple[bytes, ...]:
    about_files = {
        "netcat": "nc.openbsd/*/about.txt",
        "ping": "ping/*/about.txt",
        "capture": "tcpdump/4.99.3/about.txt",
    }
    about_files |= {"recorder": "ros2-bag/jazzy/record-help.txt"}
    parts = [b"==> user <==\n1000\n\n==> exit 0 <==\n"]
    parts += [
        b"==> %s <==\n%s\n==> exit 0 <==\n" % (name.encode(), _stored(file)[0]) for name, file in about_files.items()
    ]
    return (b"".join(parts), *_stored("*/*/*about.txt", "*/*/record-help.txt"))


def _fetch_tar(data: bytes, place: Path) -> None:
    fetching.fetch(AnsweringRobot(place, data), "x", "sender", "lo", place)


def _tar_seeds() -> tuple[bytes, ...]:
    folder = LOS / "repeats" / "udp-01"
    small = (path for path in sorted(folder.iterdir()) if path.stat().st_size < 9000)
    files = [(path.name.encode(), path.read_bytes()) for path in small if not laptop_files.is_reserved(path.name)]
    members = [entry(b"scan/scan.db3", b"x"), *(entry(name, content) for name, content in files)]
    tar = b"".join(members) + bytes(1024)
    names = [member.name for member in archive.members(io.BytesIO(tar), "robot")]
    assert len(names) == len(members)
    return (tar,)


def _read_replies(data: bytes, place: Path) -> None:
    shells = [AnsweringRobot(place, data, code=code, stderr=data) for code in (0, 1, 28, 75, 76, 255)]
    for shell in shells:
        for query in (locks.read_lock, partial(jobs.list_running, deadline=Deadline.after(1)), _call_script):
            with suppress(RobotError):
                query(shell)
    robot_clock.parse_date(data.decode("ascii", "replace"))
    printable(data)


def _call_script(shell: AnsweringRobot) -> None:
    script.call(shell, "begin", deadline=Deadline.after(1))


def _read_journal(data: bytes, place: Path) -> None:
    (place / journal.JOURNAL_FILE).write_bytes(data)
    for _ in range(2):
        with suppress(EvidenceError):
            result = journal.history(place, _plan())
            journal.ended_attempts(result)
            journal.interrupted_attempts(result)
        journal.remove_torn_line(place)


def _measure_attempt(name: str, data: bytes, place: Path) -> None:
    """Measure an attempt with one mutated file; errors that the evidence stores are also raised."""
    trial_plan, folders = _plan(), sorted((LOS / "repeats").glob("*-0?"))
    for folder in folders[:1] + folders[-1:]:
        attempt = place / folder.name
        shutil.copytree(folder, attempt, copy_function=lambda source, target: Path(target).symlink_to(source))
        (attempt / name).unlink(missing_ok=True)
        (attempt / name).write_bytes(data)
        result = AttemptEvidence(attempt)
        protocol, _, number = folder.name.partition("-")
        scene = trial_plan.scene(
            RepeatId(next(candidate for candidate in trial_plan.protocols if candidate == protocol), int(number)), ""
        )
        for placed in trial_plan.procedure.walk():
            view = View(scene, result, placed.within)
            placed.step.measure(view)
            list(placed.step.check(view))
        for error in result._errors.values():
            if error.__cause__ is not None and not isinstance(error.__cause__, OSError | ReaderError):
                raise error.__cause__


@cache
def _plan() -> plan.Plan:
    return plans.read_plan(LOS)


def _rebuild_trial(name: str, data: bytes, place: Path) -> None:
    folder = place / LOS.name
    shutil.copytree(LOS, folder, copy_function=lambda source, target: Path(target).symlink_to(source))
    for path in (*folder.glob("*.csv"), folder / name):
        path.unlink()
    (folder / name).write_bytes(data)
    rebuild.rebuild(folder)


def _read_csv(data: bytes, place: Path) -> None:
    (place / "trial.csv").write_bytes(data)
    duplicates.deduplicated(table_files.read([place / "trial.csv"], columns.trial_columns()))


def _verify_manifest(path: Path) -> None:
    verification.verify(path.parent)


def _load_site(path: Path) -> None:
    load_site(path)


def _load_campaign(path: Path) -> None:
    load_campaign(path)


def _parse_text(parse: Callable[[str], object], data: bytes, _: Path) -> None:
    parse(data.decode(errors="replace"))


def _read_evidence(read: Callable[[Path], object], data: bytes, place: Path) -> None:
    _read_file(read, "evidence.txt", data, place)


def _read_host(path: Path) -> None:
    host.read_counters(path)
    host.station_dump(path)
    state = host.read_state(path)
    for termination in (state.terminations or {}).values():
        terminations.termination_error(termination, frozenset({terminations.Cause.EXITED}))
    if state.clock is not None:
        clock.step_description(state.clock, state.clock)


def _measure_ping(text: str) -> None:
    result = ping.parse(text)
    ping.measure(result)
    assert len(result.unanswered_seqs) <= 1 << 16


def _measure_track(path: Path) -> None:
    result = track.read(path)
    track.separation_between(result, Role.SENDER, Role.RECEIVER, 0, 1 << 62)


def _measure_iperf3(path: Path) -> None:
    result = iperf3.read(path)
    for protocol in Protocol:
        measured = iperf3.measure(protocol, result, result)
        assert all(isinstance(value, int | float) for value in measured.values.values())


def _topic_logs() -> tuple[bytes, ...]:
    """Return the logs of both ends of a topic, as the agent writes them."""
    start_ns = 1_700_000_000 * 10**9
    start_records = [(2, 0, 0, 0, 0, start_ns), (3, 0, 0, 0, 0, start_ns + 10**8)]
    samples = [
        (1, 0, 220, number, start_ns + number * 10**8, start_ns + number * 10**8 + 10**6) for number in range(20)
    ]
    reads = [(9, 0, 0, number, start_ns + number * 10**8, start_ns + number * 10**8 + 10**7) for number in range(20)]
    unreadable = (10, 0, 220, 0, 0, start_ns)
    logs = (
        [*start_records, *samples, (5, 0, 0, 3, 0, start_ns), (7, 0, 0, 20, 0, start_ns)],
        [*start_records, *samples[::2], *reads[::2], unreadable],
    )
    complete, killed = (records.MAGIC + b"".join(records.RECORD.pack(*record) for record in log) for log in logs)
    return complete, killed + bytes(500)


def _measure_tlog(path: Path) -> None:
    result = tlog.measure(tlog.read(path, 0, 0))
    assert all(math.isfinite(value) for value in result.values.values() if not isinstance(value, str))
    for kind in (tlog.LOCAL, tlog.GLOBAL):
        for stamps in ("header", "received"):
            with suppress(EvidenceError):
                tlog_positions.read_tlog(path, PositionSource(topic=kind, stamps=stamps))


def _measure_topic_log(path: Path) -> None:
    result = topic_samples.read_log(path)
    flow = TopicTraffic("10.0.0.1", "10.0.0.2", frozenset({1}), frozenset({2}), deadline_s=0.1)
    plan = TopicPlan("/stream", 20, 84, 16, reliable=True, depth=10, in_order=True, uses_expected_ports=True)
    list(topic_checks.check_logs(plan, result, result))
    list(topic_captures.check_captures(plan, result, result, CapturedTopic(None, None, complete=False)))
    topic_columns.measure(flow, result, result, None, None)
    list(read_checks.check_reads(result))
    packets = RtpPackets(*(np.arange(20) for _ in range(4)))
    list(video_checks.check_captures(result, result, packets, packets))
    video_columns.measure_packets(packets, packets, result, 0.1)
    clocks = Clocks(0, 0, 0.0, 0.0, *(np.zeros(1) for _ in range(3)))
    sample_reads.measure(ReadPlan("used", 20.0, 0.5, 0.1), result, result, clocks, "no captures")


def _read_program_output(data: bytes, place: Path) -> None:
    """Evaluate paths and expressions in a mutated output of a program."""
    path = place / "run.txt"
    path.write_bytes(data)
    readings = (
        *(
            partial(program_output.at_path, path, path_text)
            for path_text in ("[0].a[1].b", "end.sum.bytes", "@", "*", "[].a[]")
        ),
        *(
            partial(program_output.by_expression, path, expression)
            for expression in (r"(a+)+$", r"= ([0-9]+)", r"(?s)(.*)")
        ),
    )
    for reading in readings:
        for unit in ("V", "count", "ns", "share", "bool", "text"):
            with suppress(EvidenceError):
                program_output.to_column_value(Column("x", unit, "X."), reading())


def _all_targets() -> Iterator[Target]:
    yield Target("bag", (*_stored("rosbag/*/*"), *_battery_bags()), partial(_read_file, _read_bag, "scan.bag"), 2)
    for storage in ("db3", "mcap"):
        yield Target(
            f"ros2-{storage}",
            (_ros2_files(storage)[f"scan_0.{storage}"],),
            partial(_read_ros2_bag, storage, storage),
            2,
        )
    yield Target(
        "ros2-metadata", (_ros2_files("db3")["metadata.yaml"],), partial(_read_ros2_bag, "db3", "metadata.yaml"), 0.3
    )
    yield Target("pcap", _stored("tcpdump/**/*.pcap"), _parse_capture, 4)
    yield Target("pcapng", _stored("tshark/**/*.pcapng"), _parse_capture, 4)
    pings = _stored("ping/*/*.txt", "busybox/*/ping*.txt")
    yield Target("ping", (*pings, *_stored_attempts("ping.txt")), partial(_parse_text, _measure_ping), 3)
    yield Target("tcpdump-log", _stored("tcpdump/*/*.log"), partial(_parse_text, tcpdump_log.parse))
    yield Target("host", _stored_attempts("*-before.txt", "*-after.txt"), partial(_read_evidence, _read_host))
    yield Target(
        "lateness",
        _stored_attempts(oracle_delays.LATENESS_FILE),
        partial(_read_evidence, oracle_delays.read_lateness),
    )
    yield Target(
        "medium",
        _stored_attempts(oracle_delays.AIR_DELAY_FILE),
        partial(_read_evidence, oracle_delays.read_air_delay),
    )
    yield Target("track", _stored_attempts(track.FILE), partial(_read_evidence, _measure_track))
    yield Target("fault", _stored_attempts("fault-*.txt"), _measure_fault)
    yield Target("iperf3", _stored("iperf3/*/*.json"), partial(_read_evidence, _measure_iperf3))
    yield Target(
        "tlog", (flight(3), flight(2, lost=lambda at: at % 3 == 1)), partial(_read_file, _measure_tlog, "x.tlog")
    )
    summary = b'{"frames": 203, "left_out": 0, "ended_us": 1795000010000000, "refused": {"32": 2}}\n'
    yield Target("tlog-summary", (summary,), partial(_read_evidence, tlog.read_summary))
    yield Target("topic-log", _topic_logs(), partial(_read_evidence, _measure_topic_log))
    yield Target(
        "printed", (b'[{"a": [1, {"b": "12.5"}]}, "x = 3"]', *_stored("iperf3/3.12/*.json")), _read_program_output
    )
    yield Target("iw", (*_stored("iw/*.txt", "ip/*/*", "ethtool/*/*"), *_probe_seeds()), _judge_sections, 2)
    yield from radio_targets()
    yield from motion_targets()
    yield from federate_targets()
    yield Target("tools", _tool_seeds(), _parse_tools)
    yield Target("tar", _tar_seeds(), _fetch_tar, 2)
    yield Target("replies", _SCRIPT_REPLIES, _read_replies)
    yield Target("journal", _stored("*/journal.jsonl", below=TRIALS), _read_journal, 2)
    yield Target("csv", _stored("fieldkit/*/trial.csv", "fieldkit/*/trials/*/trial.csv"), _read_csv)
    yield Target(
        "manifest",
        _stored("*/MANIFEST.sha256", below=TRIALS),
        partial(_read_file, _verify_manifest, "MANIFEST.sha256"),
    )
    yield from _yaml_targets()
    for name in (
        "sender.pcap",
        "receiver.pcap",
        "ping.txt",
        "receiver-before.txt",
        "scan.bag",
        "receiver-capture.log",
    ):
        yield Target(
            f"attempt-{name}".replace(".", "_"), _stored_attempts(name), partial(_measure_attempt, name), 0.5
        )
    for name in (journal.JOURNAL_FILE, plan.PLAN_FILE):
        yield Target(
            f"trial-{name}".replace(".", "_"), ((LOS / name).read_bytes(),), partial(_rebuild_trial, name), 0.2
        )


def _yaml_targets() -> Iterator[Target]:
    def of(model: type[schema.Strict]) -> Callable[[bytes, Path], None]:
        return partial(_read_file, lambda path: schema.load(path, model), "file.yaml")

    yield Target("plan", _stored("*/trial.yaml", below=TRIALS), of(plan.Plan))
    yield Target("procedure", _stored("*.yaml", below=ROOT / "procedures"), of(Procedure))
    yield Target("robot", _stored("*.yaml", below=ROOT / "robots"), of(RobotProfile))
    yield Target("site", (_SITE,), partial(_read_file, _load_site, "fieldkit.yaml"))
    yield Target("campaign", (_CAMPAIGN,), partial(_read_file, _load_campaign, "campaign.yaml"))


_SITE: Final = b"""\
robots:
  turtlebot-1:
    profile: turtlebot3_burger
    host: 192.168.1.11
    address: 10.42.0.1
    host_key: ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJ0dzS0tXUfSGRlaxQ2bRzLVBYBEv0hVlGPX9T8hYJq1
  turtlebot-2: {profile: turtlebot3_burger, host: 192.168.1.12, address: 10.42.0.2}
  drone: {profile: duckiedrone, host: 192.168.1.13, address: 10.42.0.3}
control: separate
roles:
  master: {sender: turtlebot-1, receiver: turtlebot-2, relay: drone}
  masterless: {sender: turtlebot-1, receiver: turtlebot-2}
"""
_CAMPAIGN: Final = b"""\
name: lawn
procedures: [los, nlos]                # each brings its scenario
distances: [10ft, 20ft, 30ft]
topologies: [master, masterless]
protocols: [tcp, udp]                  # optional, as are the next two: otherwise the procedure's
repeats: 20
record: 15s
seed: 7                                # of the order, and of all that is random in the trials
walk: 300m
"""


@cache
def _targets_by_name() -> dict[str, Target]:
    return {target.name: target for target in _all_targets()}


def select_targets(names: str) -> Sequence[Target]:
    """Return the targets with these names, separated by commas; all targets if it is empty."""
    return [
        (_targets_by_name() | {PLANTED.name: PLANTED})[name]
        for name in (names.split(",") if names else _targets_by_name())
    ]


NAMES: Final = tuple(_targets_by_name())

# This pattern is like that of an earlier version of the `iw` reader. For each empty line, it also matches all
# following empty lines.
_SQUARE: Final = re.compile(r"^\s*type (.{1,30})$", re.MULTILINE)
PLANTED: Final = Target("planted", [b"\n" * MAX_BYTES], partial(_parse_text, _SQUARE.search), cpu_s=0.5)
"""A target with a planted defect that a search must find; it is not in `NAMES`."""
