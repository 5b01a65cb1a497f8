"""With `control: radio`, jobs continue while the sender is out of range, and no job runs twice."""

import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import pytest
from scapy.layers.inet import TCP, UDP
from scapy.utils import rdpcap

from fieldkit.config.locations import SITE_FILE
from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.events import Event, Note, PhaseStarted
from fieldkit.core.model import Fault, FaultKind, Protocol, Role
from fieldkit.core.prompts import Unattended
from fieldkit.core.units import parse_distance
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.runner import run_trial
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.testbed import EmulatedTestbed
from tests.helpers.known_radio import make_lab
from tests.helpers.runs import only_trial, rows
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

UnderWay = Callable[[EmulatedTestbed], bool]

# Longer than the time until an outage is detected, so that fieldkit closes the connection and reconnects afterwards.
OUTAGE_S = 8.0
# At this rate a transfer takes about a second.
RADIO = "{rate: 500kbit/s}"
RECORD_S = 2.0


def inside(testbed: EmulatedTestbed) -> Path:
    """Return the /proc folder of a process in the sender's namespaces."""
    outermost = testbed.robots[Role.SENDER].pid
    first = Path(f"/proc/{outermost}/task/{outermost}/children").read_text(encoding="ascii").strip()
    return Path(f"/proc/{first}")


def jobs_of(testbed: EmulatedTestbed) -> dict[str, str]:
    """Return the identity of each current or former job of the sender, read without SSH."""
    pid_files = (inside(testbed) / "root/root/.fieldkit").glob("*/*/.jobs/*/pid")
    return {path.parent.name: path.read_text(encoding="ascii") for path in pid_files}


def is_recording(testbed: EmulatedTestbed) -> bool:
    return jobs_of(testbed).get("record", "") != ""


def is_sending(testbed: EmulatedTestbed) -> bool:
    sender, receiver = (testbed.robots[role].name for role in (Role.SENDER, Role.RECEIVER))
    return testbed.medium.stats().links[sender, receiver].sent > 5


@dataclass
class Observations:
    """The notes of a trial, and the jobs of its sender before the outage and before the evidence is collected."""

    notes: list[str] = field(default_factory=list)
    before: dict[str, str] = field(default_factory=dict)
    after: dict[str, str] = field(default_factory=dict)


@contextmanager
def capture(testbed: EmulatedTestbed, path: Path) -> Iterator[None]:
    """Capture the packets of the transfer and of SSH on the sender's radio."""
    enter = ("nsenter", f"--net={inside(testbed)}/ns/net")
    options = ("-n", "-U", "--immediate-mode", "-s", "128", "-B", "4096", "-Z", "root", "-w", str(path))
    argv = (*enter, "tcpdump", "-i", "wlan0", *options, "tcp port 22 or port 1234")
    with subprocess.Popen(argv, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "listening on" in process.stderr.readline()
        try:
            yield
        finally:
            process.terminate()


def control_packets_during_transfer(path: Path) -> list[str]:
    """Return the SSH packets of fieldkit or a robot over the radio during the transfer.

    Pure acknowledgements are omitted. The packets with which the kernels close a broken connection are also omitted:
    TCP retransmits unacknowledged data with exponential backoff, and receives a reset. So are copies of the answer of
    sshd to the command that started the transfer: on a busy machine it is sent only after the first packets of the
    transfer, and the outage can begin before it arrives.
    """
    packets = list(rdpcap(str(path)))
    times = [
        float(packet.time)
        for packet in packets
        if any(packet[kind].dport == 1234 for kind in (TCP, UDP) if kind in packet)
    ]
    control = [packet for packet in packets if TCP in packet and 22 in (packet[TCP].sport, packet[TCP].dport)]
    assert control
    assert times
    requests = [packet for packet in control if packet[TCP].dport == 22 and len(packet[TCP].payload) > 0]
    last_request_s = max(float(packet.time) for packet in requests if float(packet.time) < min(times))
    answer = next(
        packet[TCP]
        for packet in control
        if packet[TCP].sport == 22 and len(packet[TCP].payload) > 0 and float(packet.time) > last_request_s
    )
    newest_port = [packet[TCP].sport for packet in control if packet[TCP].flags == "S"][-1]
    ends: dict[tuple[int, int], int] = {}
    control_packets = []
    for packet in control:
        tcp = packet[TCP]
        direction, end = (tcp.sport, tcp.dport), tcp.seq + len(tcp.payload)
        is_kernel_cleanup = newest_port not in direction and (end <= ends.get(direction, 0) or tcp.flags == "R")
        ends[direction] = max(end, ends.get(direction, 0))
        if (
            min(times) < float(packet.time) < max(times)
            and (len(tcp.payload) > 0 or tcp.flags != "A")
            and not is_kernel_cleanup
            and (tcp.sport, tcp.dport, tcp.seq) != (answer.sport, answer.dport, answer.seq)
        ):
            control_packets.append(packet.summary())
    return control_packets


def run_with_outage(lab_folder: Path, protocol: Protocol, phase: str, is_under_way: UnderWay) -> Observations:
    """Run a trial of one repeat; its sender leaves the range in `phase` as soon as `is_under_way` returns True."""
    backend = EmulatedBackend(*load_site(lab_folder / SITE_FILE))
    request = TrialRequest(
        load_procedure("quick"), parse_distance("5m"), protocols=(protocol,), repeats=1, record_s=RECORD_S
    )
    cast = backend.cast(request.effective_topology)
    plan = make_plan(request, backend="emulated", cast=cast, now=datetime.now(UTC))
    observations = Observations()

    def leave_range() -> None:
        wait_until(lambda: is_under_way(testbed), Deadline.after(60))
        observations.before = jobs_of(testbed)
        testbed.inject(Fault(FaultKind.OUT_OF_RANGE, Role.SENDER, OUTAGE_S))

    outage = threading.Thread(target=leave_range)

    def watch(event: Event) -> None:
        match event:
            case Note(text):
                observations.notes.append(text)
            case PhaseStarted(name) if name == phase:
                outage.start()
            case PhaseStarted("collect evidence"):
                observations.after = jobs_of(testbed)

    with backend.open(cast, seed=1, sink=watch, operator=Unattended()) as opened_testbed:
        assert isinstance(opened_testbed, EmulatedTestbed)
        testbed = opened_testbed
        with capture(testbed, lab_folder / "radio.pcap"):
            run_trial(plan, testbed, lab_folder / "trials", watch)
        outage.join()
    return observations


@pytest.mark.parametrize(
    ("protocol", "phase", "is_under_way"),
    [
        (Protocol.TCP, "record", is_recording),
        (Protocol.TCP, "transfer", is_sending),
        (Protocol.UDP, "transfer", is_sending),
    ],
)
def test_evidence_of_a_sender_that_was_out_of_range_is_fetched_and_no_job_runs_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: Protocol, phase: str, is_under_way: UnderWay
) -> None:
    folder = make_lab(tmp_path / "lab", RADIO)
    site = folder / SITE_FILE
    site.write_text(site.read_text(encoding="utf-8") + "control: radio\n", encoding="utf-8")
    monkeypatch.chdir(folder)
    observations = run_with_outage(folder, protocol, phase, is_under_way)
    for state in ("lost", "open again"):
        link_was_reported = any(f"link is {state}" in note for note in observations.notes)
        # A TCP transfer is longer than the outage, and an idle connection is not affected by it.
        assert link_was_reported is (phase == "record" or protocol is Protocol.UDP)
    assert control_packets_during_transfer(folder / "radio.pcap") == []
    assert observations.before.keys() == ({"record"} if phase == "record" else {"record", "capture", "send"})
    assert observations.after.keys() == {"record", "capture", "send", "ping"}
    assert observations.after.items() >= observations.before.items(), (
        "the jobs that ran during the outage are the same jobs"
    )
    trial = only_trial(folder)
    (row,) = rows(trial)
    assert row["status"] == "valid", row["reason"]
    assert 0 < int(row["bag_messages"]) <= 11, "2 s of a 5 Hz laser, minus the time to subscribe"
    packets = rdpcap(str(trial / "repeats" / f"{protocol}-01" / "sender.pcap"))
    ports = {packet[layer].sport for packet in packets for layer in (TCP, UDP) if layer in packet}
    assert len(ports - {1234}) == 1, "each netcat sends from its own port"
