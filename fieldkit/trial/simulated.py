"""Trials that a simulation reproduces. Their evidence is measured by the same steps as the evidence of robots.

The simulation provides captures of both ends and the output of ping, which are written to the files of an attempt.
Columns that need other evidence are missing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import load_profile
from fieldkit.core.columns import Value
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Distance, Protocol, RepeatId, Role, Scenario, Status, Topology
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.steps.view import capture_around
from fieldkit.trial import gates, rows
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest, make_plan

KINDS: Final = ("capture", "ping", "record", "transfer")
"""Kinds of step that a simulation can reproduce. Only the size of a recording is reproduced."""


@dataclass(frozen=True)
class SimulatedRobot:
    """A robot of a simulation.

    Attributes:
        name: Name of the robot.
        profile: Name of the robot's profile.
        address: IPv4 address of the robot in the captures.
    """

    name: str
    profile: str
    address: str


@dataclass(frozen=True)
class PlannedExchange:
    """Traffic of the procedure with one protocol: a transfer and a ping.

    Attributes:
        sender: Role that sends the file and the echo requests.
        receiver: Role that receives the file and the echo requests.
        port: Port of the transfer.
        requests: Number of echo requests.
        interval_s: Time between two echo requests in seconds.
        payload_bytes: Payload of an echo request.
    """

    sender: Role
    receiver: Role
    port: int
    requests: int
    interval_s: float
    payload_bytes: int


@dataclass(frozen=True)
class SimulatedRepeat:
    """A repeat of a simulation.

    Attributes:
        repeat: Protocol and number of the repeat.
        status: Status of the repeat.
        reason: Reason why the repeat is not valid; empty if it is valid.
        captures: Contents of the captures of sender and receiver; empty if the simulation has no captures.
        ping: Output of ping.
        values: Columns that the simulation provides without evidence.
    """

    repeat: RepeatId
    status: Status
    reason: str
    captures: Mapping[Role, bytes]
    ping: str
    values: Mapping[str, Value]


class SimulatedTrial:
    """A trial that a simulation reproduces.

    Args:
        procedure: Name of the procedure.
        robots: The robot in each role.
        topology: The topology.
        distance: The distance.
        record_s: Duration of every recording, in seconds; None for the duration in the procedure.
        backend: Name of the simulation, for the column `backend`.
        seed: Seed of the simulation.

    Raises:
        ConfigurationError: There is no such procedure, or a simulation cannot reproduce it.
    """

    def __init__(
        self,
        procedure: str,
        *,
        robots: Mapping[Role, SimulatedRobot],
        topology: Topology,
        distance: Distance,
        record_s: float | None,
        backend: str,
        seed: int,
    ) -> None:
        loaded_procedure = load_procedure(procedure)
        kinds = sorted({placed.kind for placed in loaded_procedure.walk()})
        if other_kinds := set(kinds) - set(KINDS):
            raise ConfigurationError(
                f"a simulation cannot reproduce the procedure {procedure}: it has {', '.join(sorted(other_kinds))}",
                remedy=f"name a procedure that has only {', '.join(KINDS)}",
            )
        cast = {
            role: Robot(name=robot.name, address=robot.address, profile=load_profile(robot.profile))
            for role, robot in robots.items()
        }
        request = TrialRequest(loaded_procedure, distance, topology, record_s=record_s, seed=seed)
        # The time is used only in the trial's name, which rows of simulations do not contain.
        self._plan = make_plan(request, backend=backend, cast=cast, now=datetime.fromtimestamp(0, UTC))

    @property
    def procedure(self) -> str:
        """Name of the procedure."""
        return self._plan.procedure.name

    @property
    def scenario(self) -> Scenario:
        """Scenario of the procedure: with or without an obstacle."""
        return self._plan.procedure.scenario

    def exchange(self, protocol: Protocol) -> PlannedExchange:
        """Return the traffic of the procedure with a protocol.

        Raises:
            ConfigurationError: The procedure does not have exactly one transfer and one ping between the same robots,
                or the transfer is not captured on both robots.
        """
        transfers = [placed for placed in self._plan.procedure.walk() if isinstance(placed.step, TransferStep)]
        pings = [placed.step for placed in self._plan.procedure.walk() if isinstance(placed.step, PingStep)]
        if len(transfers) == len(pings) == 1:
            (placed,), (ping_step,) = transfers, pings
            step = placed.step
            assert isinstance(step, TransferStep)
            ends = step.sender, step.receiver
            is_captured = all(capture_around(placed.within, role) for role in ends)
            if is_captured and ends == (ping_step.sender, ping_step.receiver):
                payload_bytes = ping_step.payload_of(protocol)
                return PlannedExchange(*ends, step.port, ping_step.count, ping_step.interval, payload_bytes)
        raise ConfigurationError(
            f"a simulation cannot reproduce the procedure {self._plan.procedure.name}",
            remedy="it needs one transfer and one ping between two robots, and captures on both around the transfer",
        )

    def row(self, simulated: SimulatedRepeat, identity: Mapping[str, Value]) -> Row:
        """Return the row of a repeat.

        Args:
            simulated: The repeat.
            identity: Columns that replace columns of the plan, for example the name of the trial.
        """
        with TemporaryDirectory(prefix="fieldkit-simulated-") as name:
            folder = Path(name)
            self._write(simulated, folder)
            measured = gates.judge(self._plan, simulated.repeat, AttemptEvidence(folder)).measured
        status, reason = simulated.status, simulated.reason
        if status is Status.VALID and (contradictions := differences(measured.values, simulated.values)):
            status, reason = Status.FAILED, f"captures and simulation disagree: {contradictions}"
        row = rows.build(self._plan, Attempt(simulated.repeat, 1, 0, status, reason), measured)
        row = {**row, **simulated.values}
        return {
            key: value for key, value in {**row, **_goodput(row), **identity}.items() if key not in _CLOCK_COLUMNS
        }

    def _write(self, simulated: SimulatedRepeat, folder: Path) -> None:
        """Write the evidence of a repeat."""
        for placed in self._plan.procedure.walk():
            if isinstance(placed.step, TransferStep):
                for role, content in simulated.captures.items():
                    (folder / str(capture_around(placed.within, role))).write_bytes(content)
            if isinstance(placed.step, PingStep):
                (folder / placed.step.ping_source().file).write_text(simulated.ping, encoding="ascii")


def differences(measured: Mapping[str, Value], known_values: Mapping[str, Value]) -> str:
    """Return a text that names the columns with different values in evidence and simulation; empty without any."""
    tcp_names = {"received_bytes": "tcp_received_bytes", "sent_bytes": "tcp_unique_bytes"}
    pairs = list(known_values.items())
    # For TCP, captures give these values in other columns.
    pairs += [(tcp_names[name], value) for name, value in known_values.items() if name in tcp_names]
    difference_texts = []
    for name, value in pairs:
        measured_value = measured.get(name)
        if not isinstance(measured_value, int | float) or not isinstance(value, int | float):
            continue
        if not math.isclose(measured_value, value, rel_tol=1e-9, abs_tol=1e-12):
            difference_texts.append(f"{name} is {measured_value:g} in the captures and {value:g} in the simulation")
    return "; ".join(difference_texts)


def _goodput(row: Mapping[str, Value]) -> dict[str, Value]:
    """Return the goodput as `measure.transfers.rates` defines it.

    The bytes of the first packet are not counted if it is a whole datagram, that is, if no datagram was fragmented.
    """
    received_bytes, completion_s = row.get("received_bytes"), row.get("completion_s")
    if not isinstance(received_bytes, int) or not isinstance(completion_s, float) or completion_s <= 0:
        return {}
    head_bytes, datagrams = 0, row.get("datagrams_received")
    if isinstance(datagrams, int) and datagrams and row.get("datagrams_sent") == row.get("ip_packets_sent"):
        head_bytes = math.ceil(received_bytes / datagrams)
    return {"goodput_bit_s": 8 * max(received_bytes - head_bytes, 0) / completion_s}


_CLOCK_COLUMNS: Final = frozenset({"started_utc_ns"})
"""Columns of a trial's clock, which a simulation does not have."""
