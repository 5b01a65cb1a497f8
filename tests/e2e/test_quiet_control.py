"""No packet uses a control connection during the measurement of a transfer or a ping."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from fieldkit.backends.protocols import Testbed
from fieldkit.backends.registry import load_backend
from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Protocol, RepeatId, Role, Topology
from fieldkit.core.prompts import Unattended
from fieldkit.core.units import parse_distance
from fieldkit.measure.captures import pcap
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.labs import built_in_ros
from tests.helpers.plans import steps_of

# A busy robot may respond to the command that starts a program when the program already sends.
pytestmark = [pytest.mark.emulated, pytest.mark.quiet]

FOLDER = ".fieldkit/quiet/{}"
ENDS = (Role.SENDER, Role.RECEIVER)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Testbed, Scene]]:
    backend = load_backend("emulated", *load_site(built_in_ros(tmp_path_factory.mktemp("lab"))))
    cast = backend.cast(Topology.MASTERLESS)
    request = TrialRequest(
        procedure=load_procedure("los"), distance=parse_distance("5m"), topology=Topology.MASTERLESS
    )
    plan = make_plan(request, backend="emulated", cast=cast, now=datetime.now(UTC))
    with backend.open(cast, seed=1, sink=lambda event: None, operator=Unattended()) as emulation:
        emulation.place(plan.placement)
        yield emulation, plan.scene(RepeatId(Protocol.UDP, 1), "")


def watch(folder: str, interface: str, expression: str) -> Job:
    options = ("-n", "-U", "--immediate-mode", "-s", "96", "-B", "4096")
    return Job(
        folder=folder,
        name=f"watch-{interface}",
        argv=("tcpdump", "-i", interface, *options, "-w", f"{interface}.pcap", expression),
        limit_s=120,
        log=f"{interface}.log",
        ready="log:listening on",
    )


@pytest.mark.parametrize("protocol", Protocol)
def test_the_control_connection_is_silent_during_measurements(
    lab: tuple[Testbed, Scene], protocol: Protocol, tmp_path: Path
) -> None:
    emulation, scene = lab
    folder = FOLDER.format(protocol)
    scene = replace(scene, protocol=protocol, folder=folder)
    watches = [
        watch(folder, "lo", "tcp port 22"),
        watch(folder, "wlan0", "port 1234 or icmp or ip[6:2] & 0x1fff != 0"),
    ]
    for role in ENDS:
        jobs.install(emulation.shells[role], Deadline.after(30))
        evidence.begin(emulation.shells[role], folder, role, "wlan0")
        for watch_job in watches:
            jobs.start(emulation.shells[role], watch_job)
        for _ in range(5):  # the packets of these commands show that the capture of the control connection works
            emulation.shells[role].run(("true",), deadline=Deadline.after(30))
    emulation.shells[Role.SENDER].run(
        ("sh", "-c", f"head -c 200000 /dev/zero >{folder}/scan.bag"), deadline=Deadline.after(30)
    )

    procedure = load_procedure("los")
    for step in (*steps_of(procedure, TransferStep), *steps_of(procedure, PingStep)):
        step.run(scene, emulation, lambda name, expected_s: None)

    for role in ENDS:
        for watch_job in watches:
            jobs.stop(emulation.shells[role], watch_job, settle=f"{watch_job.name.removeprefix('watch-')}.pcap")
        evidence_folder = tmp_path / role
        evidence_folder.mkdir()
        fetching.fetch(emulation.shells[role], folder, role, "wlan0", evidence_folder)
        control, radio = (pcap.read(evidence_folder / name).packets for name in ("lo.pcap", "wlan0.pcap"))
        control_ns = control.time_ns[control.tcp_payload_bytes > 0]
        assert len(control_ns) > 10, "the capture of the control connection works"
        is_transfer = (radio.sport == 1234) | (radio.dport == 1234)
        for name, is_measured in (("transfer", is_transfer), ("ping", radio.protocol == 1)):
            times_ns = radio.time_ns[is_measured]
            assert len(times_ns) > 10, name
            is_during = (control_ns > times_ns.min()) & (control_ns < times_ns.max())
            assert not np.any(is_during), f"{role}: {is_during.sum()} segments of SSH during the {name}"
