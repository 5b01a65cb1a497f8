"""Send a file from one robot to another with netcat."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import PurePosixPath
from typing import Annotated, ClassVar, Final

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Int
from fieldkit.core.columns import Measured, Value
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.core.units import format_count
from fieldkit.measure.checks import transfer_checks
from fieldkit.measure.checks.transfer_checks import CROSS_CHECKS
from fieldkit.measure.evidence import host, oracle_delays, reading
from fieldkit.measure.evidence.terminations import Cause, Termination
from fieldkit.measure.transfers import stalls, transfer_measures
from fieldkit.measure.transfers.deliveries import StreamDeliveries
from fieldkit.measure.transfers.transfer_columns import COLUMNS
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job, PendingJob
from fieldkit.steps import netcat
from fieldkit.steps.base import FileName, Step
from fieldkit.steps.capabilities import (
    ChecksPlacement,
    HasNeeds,
    HasRefusals,
    Listens,
    Prepares,
    Records,
    SendsFile,
    SendsTraffic,
    Summarizes,
    UsesSpace,
    WritesOnLaptop,
)
from fieldkit.steps.nest import Nest, flows_inside
from fieldkit.steps.over_link import OverLink
from fieldkit.steps.scene import (
    BY_EXIT_OR_LIMIT,
    Announce,
    Flow,
    ListeningPort,
    Need,
    Planned,
    RecordedFile,
    Refusal,
    Scene,
    frames,
)
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.variants import Netcat, Tool
from fieldkit.steps.view import View, capture_around

BagName = Annotated[
    str,
    schema.pattern_field(
        r"^[a-z][a-z0-9_.-]{0,40}(/[a-z][a-z0-9_.-]{0,40})?$",
        "the name of a recording (scan), or of its file (scan.bag or scan/scan_0.db3)",
    ),
]

_LISTEN: Final = "listen"
_SEND: Final = "send"
_START_S: Final = 0.3
"""Approximate duration of a transfer on a good link, without the idle time of UDP."""
MAX_LATE_SHARE: Final = 0.1
"""Maximum time between the start of a TCP listener and the start of its sender, as a share of the listener's limit.
It applies if the listener did not exit with 0, for example because it was stopped at its limit."""


class TransferStep(
    Step,
    OverLink,
    Prepares,
    ChecksPlacement,
    HasNeeds,
    HasRefusals,
    UsesSpace,
    Listens,
    SendsTraffic,
    SendsFile,
    WritesOnLaptop,
    Summarizes,
):
    """Sends a file with netcat over the protocol of the repeat, TCP or UDP.

    The receiver runs `nc -l -p PORT > recv.bag`, the sender `nc ADDRESS PORT < scan.bag`, with the options of the
    [netcat that each robot has](method-loss.md#tools-that-differ). A TCP transfer ends when its connection closes, a
    UDP transfer when nothing has arrived for `idle`.

    Attributes:
        sender: Role that sends; columns with "sender" in their name refer to it.
        receiver: Role that receives.
        file: The file to send: name of a recording on the sender (`scan`) or of its file (`scan.bag`). Without this
            key, the only recording on the sender is sent.
        into: The file written by the receiver.
        port: Port that the receiver listens on.
        idle: A UDP listener exits after this time without a datagram; at least `1s`, rounded up to whole seconds.
        limit: Maximum duration. A longer transfer is stopped, and the data received until then is measured.
    """

    columns = COLUMNS
    flow_kind: ClassVar[str] = "transfer"
    cross_checks = (*CROSS_CHECKS, *stalls.cross_checks("transfer"))

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    file: BagName | None = None
    into: FileName = "recv.bag"
    port: Annotated[Int, Field(gt=0, lt=65536)] = 1234
    idle: Annotated[Duration, Field(ge=1)] = 2.0
    limit: Annotated[Duration, Field(gt=0)] = 120.0

    @schema.model_validator(mode="after")
    def _has_two_ends(self) -> "TransferStep":
        if self.sender == self.receiver:
            raise schema.validation_error(f"{self.sender} cannot send to itself; name another robot", "to")
        return self

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        recorders = [step for step in earlier if isinstance(step, Records) and self.sender in step.records_on()]
        transfer_text = f"the transfer from {self.sender} {f'sends {self.file}' if self.file else 'names no file'}"
        if not recorders:
            return f"{transfer_text}, but no step before it records on {self.sender}"
        if self.file is None and len(recorders) > 1:
            return f"{transfer_text}, but {len(recorders)} files are recorded there before it: write file:"
        files = {name for step in recorders for name in step.files()}
        if self.file and PurePosixPath(self.file).parts[0] not in files:
            return f"{transfer_text}, but no recording of that name is made on {self.sender} before it"
        return None

    def _file_to_send(self, scene: Scene) -> RecordedFile:
        """Return the recording to send.

        This is the first one if the step names no file, and also if no recording has the name, because `refusals`
        reports this error.
        """
        recordings = scene.recordings[self.sender]
        return next((file for file in recordings if self.file in {file.name, file.alias}), recordings[0])

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        yield from self.route_needs(scene, self.sender, self.receiver)

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield from self._netcats(scene)

    def _netcats(self, scene: Scene) -> Iterator[Planned]:
        """Yield the jobs of listener and sender."""
        listener, sender = (scene.robot(role).profile.tools.netcat for role in (self.receiver, self.sender))
        listener_variant, sender_variant = scene.tools(self.receiver).netcat, scene.tools(self.sender).netcat
        address = scene.link(self.receiver, self.over).address
        yield Planned(
            self.receiver,
            Job(
                folder=scene.folder,
                name=self.prefixed_name(_LISTEN),
                argv=netcat.listen(listener_variant, listener, scene.protocol, self.port, math.ceil(self.idle)),
                limit_s=self.limit,
                log=self._logs[0],
                stdout=self._into,
                ready=jobs.ready_when_bound(scene.protocol, self.port),
            ),
            program=listener,
            tool=Tool.NETCAT,
            permitted_causes=BY_EXIT_OR_LIMIT,
        )
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name=self.prefixed_name(_SEND),
                argv=netcat.send(sender_variant, sender, scene.protocol, address, self.port),
                limit_s=self.limit,
                log=self._logs[1],
                stdin=self._file_to_send(scene).name,
            ),
            program=sender,
            tool=Tool.NETCAT,
            permitted_causes=BY_EXIT_OR_LIMIT,
        )

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        yield from self._file_refusals(scene)
        if scene.protocol is not Protocol.UDP:
            return
        netcats = {role: scene.tools(role).netcat for role in (self.sender, self.receiver)}
        version = scene.tools(self.receiver).versions.get(Tool.NETCAT, "")
        yield from netcat.udp_refusals(netcats, self.sender, self.receiver, version)

    def _file_refusals(self, scene: Scene) -> Iterator[Refusal]:
        """Yield a reason if no recording has the name of the file to send."""
        recordings = [file.name for file in scene.recordings[self.sender]]
        file_to_send = self._file_to_send(scene)
        if self.file not in {None, file_to_send.name, file_to_send.alias}:
            reason = f"it cannot send {self.file}: its recorder writes {', '.join(recordings)}"
            leave_out = "leave out file: in the transfer, or " if len(recordings) == 1 else ""
            yield Refusal(self.sender, reason, f"{leave_out}write file: {recordings[0]}")

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Start the listener; return the function that sends the file."""
        listen, _ = self._netcats(scene)
        start_s = time.monotonic()
        pending_listener = jobs.serve(testbed.shells[self.receiver], listen.job)
        return partial(self._send, scene, testbed, pending_listener, start_s)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _send(self, scene: Scene, testbed: Testbed, listener: PendingJob, start_s: float, announce: Announce) -> None:
        """Send the file to a listener that was started at `start_s` of the monotonic clock.

        During the transfer no data crosses the control connections: both commands were accepted before, the receiver
        reports only the exit of its listener, and the sender is queried afterwards. If a control connection over the
        same radio is lost, it is restored after the transfer or at the limit.
        """
        oracle = testbed.oracle
        flow = (self.sender, self.receiver, scene.protocol, self.port)
        before = None if oracle is None else oracle.delays(*flow, link=self.over)
        _, send = self._netcats(scene)
        announce("transfer", self.expected_s(scene.protocol))
        with ExitStack() as silence_contexts:
            for role in (self.receiver, self.sender):
                silence_contexts.enter_context(testbed.shells[role].silence(self.limit))
            pending_sender = jobs.begin(testbed.shells[self.sender], send.job)
            waited_s = time.monotonic() - start_s
            if scene.protocol is Protocol.UDP and waited_s >= self.idle:
                raise self._late_start(waited_s, f"the listener exits after {self.idle:g} s of silence", scene)
            # This wait is longer than the robot needs to stop the listener at its limit, so the listener has ended
            # when the step ends.
            code = listener.end(self.limit + 2 * jobs.REPLY_S)
        if scene.protocol is Protocol.TCP and code != 0 and waited_s > MAX_LATE_SHARE * self.limit:
            raise self._late_start(waited_s, f"the listener was stopped after {self.limit:g} s", scene)
        # A sender runs longer than its listener only if the transfer was interrupted; its limit has then also passed.
        pending_sender.end(jobs.REPLY_S)
        if oracle is not None and before is not None and scene.laptop_folder is not None:
            after = oracle.delays(*flow, link=self.over)
            (scene.laptop_folder / self.prefixed_name(oracle_delays.AIR_DELAY_FILE)).write_text(
                oracle_delays.air_delay_text(before, after), encoding="ascii"
            )

    def _late_start(self, waited_s: float, reason: str, scene: Scene) -> RobotError:
        """Return the error for a sender that started so late that the radio need not be the cause of its loss."""
        return RobotError(
            f"the sender started up to {waited_s:.1f} s after the listener, but {reason}",
            where=scene.robot(self.sender).name,
            remedy="check the control link, or increase `idle` or `limit` in the procedure",
        )

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        """Return the resource of transfers, which a `send` also uses."""
        return ("a transfer",)

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        return (ListeningPort(self.receiver, self.port, self.sender),)

    @override
    def files(self) -> tuple[str, ...]:
        return (self._into, *self.laptop_files(), *self._logs)

    @override
    def laptop_files(self) -> tuple[str, ...]:
        return (self.prefixed_name(oracle_delays.AIR_DELAY_FILE),)

    @property
    def _into(self) -> str:
        return self.prefixed_name(self.into)

    @property
    def _logs(self) -> tuple[str, str]:
        """Log files of the listener and of the sender."""
        return self.prefixed_name(f"{self.receiver}-listen.log"), self.prefixed_name(f"{self.sender}-send.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        frame_count = frames(scene.protocol, self._size_bytes(scene), netcat.DATAGRAM_BYTES[Netcat.TRADITIONAL])
        yield Flow(self.sender, self.receiver, self.port, frame_count, link=self.over)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        return self._size_bytes(scene) if role == self.receiver else 0.0

    def _size_bytes(self, scene: Scene) -> float:
        return self._file_to_send(scene).size_bytes

    @override
    def transfer(self, scene: Scene, within: Sequence[EnclosingStep]) -> Transfer:
        return Transfer(
            protocol=scene.protocol,
            source=self.sender,
            destination=self.receiver,
            sender_address=scene.link(self.sender, self.over).address,
            receiver_address=scene.link(self.receiver, self.over).address,
            port=self.port,
            sent_file=self._file_to_send(scene).name,
            received_file=self._into,
            captures=(capture_around(within, self.sender), capture_around(within, self.receiver)),
            name=self.prefix,
        )

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason for a missing file, a netcat that was stopped by a signal, and each contradiction."""
        transfer = self.transfer(view.scene, view.within)
        terminations = [self._termination(view, role, job) for role, job in self._job_names]
        listener_exit, sender_exit = (
            termination if termination and termination.cause is Cause.EXITED else None for termination in terminations
        )
        if not view.evidence.has(self._into):
            yield f"{self._into} is missing"
        elif reason := transfer_measures.incomparability_reason(view.evidence, transfer):
            yield reason
        else:
            finished = listener_exit is not None and listener_exit.code == 0
            was_stopped = terminations[0] is not None and listener_exit is None
            yield from transfer_checks.find_contradictions(
                view.evidence, transfer, finished=finished, was_stopped=was_stopped
            )
        texts = [view.evidence.read_or_none(reading.text, log) for log in self._logs]
        if listener_exit is not None and netcat.listener_failed(listener_exit.code, texts[0]):
            yield f"{self._logs[0]}: netcat was terminated by a signal, or could not write {self._into}"
        if sender_exit is not None and netcat.sender_was_killed(sender_exit.code, texts[1]):
            yield f"{self._logs[1]}: netcat was terminated by a signal"

    @property
    def _job_names(self) -> tuple[tuple[Role, str], tuple[Role, str]]:
        """Role and job name of the listener, and of the sender."""
        return (self.receiver, self.prefixed_name(_LISTEN)), (self.sender, self.prefixed_name(_SEND))

    def _termination(self, view: View, role: Role, job: str) -> Termination | None:
        """Return the recorded termination of a netcat, or None if there is no record."""
        after = view.evidence.read_or_none(host.read_state, host.after_file(role))
        return (after.terminations or {}).get(job) if after else None

    @override
    def measure(self, view: View) -> Measured:
        measured = transfer_measures.measure(
            view.evidence, self.transfer(view.scene, view.within), self.prefixed_name(_LISTEN)
        )
        if self._shares_udp_counters(view.scene):
            measured = host.without_shared_counters(measured)
        if self._shares_port(view):
            measured = measured.without(
                dict.fromkeys(transfer_measures.PAPER_COUNTS, "the filter of the paper also counts another flow")
            )
        return measured

    @property
    def destination(self) -> Role:
        """Role of the receiving robot."""
        return self.receiver

    def deliveries(self, view: View) -> Sequence[StreamDeliveries]:
        """Return the deliveries of the transfer; see `SendsFlow.deliveries`."""
        return stalls.read_transfer_deliveries(
            view.evidence, self.transfer(view.scene, view.within), self.prefixed_name(_LISTEN)
        )

    def _shares_port(self, view: View) -> bool:
        """Return True if another flow in the same capture uses the port of the transfer, in either direction."""
        captures = (step for step in reversed(view.within) if isinstance(step, Nest) and step.captures())
        flows = next((list(flows_inside(nest, view.scene)) for nest in captures), [])
        return sum(flow.port == self.port for flow in flows) > 1

    def _shares_udp_counters(self, scene: Scene) -> bool:
        """Return True if other steps also send UDP to the receiver, whose kernel has one set of UDP counters."""
        flows = (flow for flow in scene.flows if flow.destination == self.receiver and flow.port is not None)
        udp_flow_count = sum((flow.protocol or scene.protocol) is Protocol.UDP for flow in flows)
        own_flow_count = 1 if scene.protocol is Protocol.UDP else 0
        return udp_flow_count > own_flow_count

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        for name, layer in (("ip_loss", "IP packet"), ("datagram_loss", "datagram"), ("file_loss", "file")):
            if name in values:
                yield f"{layer} loss {100 * float(values[name]):.1f} %"
        if values.get("ip_packets_doubtful"):
            yield format_count(int(values["ip_packets_doubtful"]), "ambiguous packet")
        if "tcp_retransmitted_segments" in values:
            yield f"{values['tcp_retransmitted_segments']} retransmitted"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return _START_S + (self.idle if protocol is Protocol.UDP else 0.0)
