"""The robots of a trial during one attempt: create folders, run the steps, fetch the evidence, clean up."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Final, TypeVar

from fieldkit.backends.protocols import Testbed, Transient
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, FieldkitError, LinkError, LockLostError, RobotError, TestbedLostError
from fieldkit.core.events import PhaseStarted, Sink
from fieldkit.core.model import RepeatId, Role
from fieldkit.core.threads import run_parallel
from fieldkit.measure.evidence import link_samples, oracle_delays, track
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.fetching import FetchProgress, LateJobError, NoFolderError
from fieldkit.steps.scene import Announce, Scene, Shells
from fieldkit.trial import hosts, size, step_errors
from fieldkit.trial.owners import FileOwners
from fieldkit.trial.plan import Plan, telemetry_cast
from fieldkit.trial.running import locks
from fieldkit.trial.running.unfetched import UnfetchedEvidence

T = TypeVar("T")

_WATCH_INTERVAL_S: Final = 0.5


class Robots:
    """The robots of a trial. Each operation runs on all robots in parallel.

    Args:
        plan: The trial.
        testbed: The testbed.
        sink: Receives the progress of fetching large evidence.
    """

    def __init__(self, plan: Plan, testbed: Testbed, sink: Sink = lambda _: None) -> None:
        self._plan = plan
        self._testbed = testbed
        self._sink = sink
        self.is_transient = isinstance(testbed, Transient)
        """True if the robots and their files are removed at the end of this run of fieldkit."""
        self._roles = sorted(plan.procedure.roles())
        protocol = plan.procedure.protocols[0]
        self._owners = FileOwners.of_procedure(plan.procedure, plan.scene(RepeatId(protocol, 1), ""))
        self._is_fetch_cancelled = False
        self.unfetched = UnfetchedEvidence(plan, self._roles, transient=self.is_transient)
        """Evidence that was not fetched and stays on the robots."""
        self._boot_ids: dict[Role, str] = {}

    @property
    def shells(self) -> Shells:
        """The control connection of each robot of the cast."""
        return self._testbed.shells

    def begin(self, remote: str, *, old: str | None) -> Mapping[Role, tuple[int, int]]:
        """Create an attempt's folder `remote` on each robot, and remove the folder `old` if its evidence was fetched.

        Programs of the lab are copied before the first step, so that copying does not use the radio during steps.

        Returns:
            Laptop's clock before the request to each robot and after the response; see `robot_state.exchanges`.

        Raises:
            FieldkitError: For the same reasons as `evidence.begin` and `programs.copy`, or because a program of the
                lab has changed.
        """
        plan = self._plan
        copies = [(put, put.program.content()) for put in plan.program_copies()]
        sources = self._telemetry_sources()

        times_ns: dict[Role, tuple[int, int]] = {}

        def create_folder(role: Role) -> None:
            request_ns = time.time_ns()
            self._boot_ids[role] = evidence.begin(
                self.shells[role],
                remote,
                role,
                self._interface(role),
                old_folder=None if old in self.unfetched.folders[role] else old,
                token=plan.session,
                required_kib=(size.evidence_bytes(plan, role) + size.reserve_bytes(plan, role)) // 1024,
                sources=sources.get(role, ()),
            )
            times_ns[role] = request_ns, time.time_ns()
            for put, content in copies:
                if put.role == role:
                    from fieldkit.remote import programs  # noqa: PLC0415 (few procedures copy programs)

                    sha256, executable = put.program.sha256, put.program.executable
                    programs.copy(self.shells[role], remote, put.at, content, sha256, executable=executable)

        self._run_on_all(create_folder)
        return times_ns

    def _telemetry_sources(self) -> Mapping[Role, Sequence[Sequence[str]]]:
        """Return the telemetry sources that each robot queries during an attempt."""
        cast = telemetry_cast(self._plan)
        if not cast:
            return {}
        from fieldkit.telemetry import telemetry_queries  # noqa: PLC0415 (few profiles have sources)

        return telemetry_queries.queries_by_role(cast)

    def measure(self, scene: Scene, announce: Announce) -> None:
        """Run all steps, and store the data of a modelled radio (`Testbed.oracle`), if the radio is not real.

        Raises the same errors as `Step.run`.
        """
        oracle = self._testbed.oracle
        if oracle is None:
            self._run_steps(scene, announce)
            return
        before, since_ns = oracle.lateness(), time.time_ns()
        oracle.links(continue_sampling=True)  # starts to sample the links, or drops the samples of the last attempt
        oracle.record_air(scene.laptop_folder)
        try:
            self._run_steps(scene, announce)
        finally:
            oracle.record_air(None)  # ends the recording of transmissions
        after, positions, links = oracle.lateness(), oracle.track(since_ns), oracle.links(continue_sampling=False)
        if scene.laptop_folder is not None:
            (scene.laptop_folder / track.FILE).write_text(track.text(positions), encoding="ascii")
            (scene.laptop_folder / link_samples.FILE).write_text(link_samples.text(links), encoding="ascii")
            (scene.laptop_folder / oracle_delays.LATENESS_FILE).write_text(
                oracle_delays.lateness_text(before, after), encoding="ascii"
            )

    def _run_steps(self, scene: Scene, announce: Announce) -> None:
        with self._monitored_processes(), ExitStack() as stack:
            if (cast := telemetry_cast(self._plan)) and scene.laptop_folder is not None:
                from fieldkit.telemetry import laptop_telemetry  # noqa: PLC0415 (few profiles have sources)

                stack.enter_context(laptop_telemetry.querying(cast, scene.laptop_folder))
            for section in self._plan.procedure.sections.values():
                stack.enter_context(section.around_steps(self._plan, scene, self.shells))
            for entry in self._plan.procedure.steps:
                with step_errors.during_attempt(entry.kind):
                    entry.step.run(scene, self._testbed, announce)

    @contextmanager
    def _monitored_processes(self) -> Iterator[None]:
        """Unblock the body if a process that the robots need has exited, because no more answers can arrive."""
        has_ended = Event()

        def watch() -> None:
            while not has_ended.wait(_WATCH_INTERVAL_S):
                try:
                    self.check_alive()
                except TestbedLostError:
                    self.close_connections()

        watch_thread = Thread(target=watch, name="testbed", daemon=True)
        if self.is_transient:
            watch_thread.start()
        try:
            yield
        finally:
            has_ended.set()
            if self.is_transient:
                watch_thread.join()

    def fetch(self, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        """Fetch the evidence of an attempt. If the attempt did not end normally, its jobs are stopped first.

        Evidence that was not fetched stays on its robot, which `ROLE-unfetched.txt` records.

        Args:
            remote: The attempt's folder on each robot.
            into: The local folder.
            ended_normally: True if the attempt ended normally.

        Returns:
            The problems, one sentence each.
        """
        self._is_fetch_cancelled = False
        problems = self._run_on_all(lambda role: self._collect(role, remote, into, ended_normally=ended_normally))
        failures = [(role, *problem) for role, problem in zip(self._roles, problems, strict=True) if problem]
        for role, reason, is_on_robot in failures:
            if is_on_robot:
                self.unfetched.mark(role, remote, into, reason)
        return [reason for _, reason, _ in failures]

    def _collect(self, role: Role, remote: str, into: Path, *, ended_normally: bool) -> tuple[str, bool] | None:
        """Fetch the evidence of one robot.

        Returns:
            The problem, and True if unfetched evidence is on the robot; None without a problem. A reboot during an
            attempt that did not end normally is a problem even if the evidence was fetched.
        """
        shell, attempt = self.shells[role], remote.rpartition("/")[2]  # for example `udp-07-1`: repeat and attempt

        def announce(progress_text: str, remaining_s: float) -> None:
            name = f"collect evidence, {progress_text} of {self._plan.cast[role].name}"
            self._sink(PhaseStarted(name, attempt.rpartition("-")[0], remaining_s))

        progress = FetchProgress(announce, lambda: self._is_fetch_cancelled)
        expected_bytes = size.evidence_bytes(self._plan, role)
        try:
            if not ended_normally:
                evidence.end_jobs(shell, remote)
            fetching.fetch(
                shell,
                remote,
                role,
                self._interface(role),
                into,
                expected_bytes=expected_bytes,
                progress=progress,
                forbidden_reason=partial(self._owners.refusal, role),
            )
        except LinkError as error:
            return error.located, True
        except (RobotError, EvidenceError) as error:
            return self._reboot_message(role) or error.located, not isinstance(error, (NoFolderError, LateJobError))
        message = None if ended_normally else self._reboot_message(role)
        return (message, False) if message else None

    def _reboot_message(self, role: Role) -> str | None:
        """Return a message if a robot is known to have rebooted unexpectedly during the attempt; otherwise None."""
        boot_id = self._boot_ids.get(role) if role not in hosts.restarted_roles(self._plan.procedure) else None
        with suppress(FieldkitError):
            if boot_id and hosts.has_rebooted(boot_id, evidence.boot_id(self.shells[role])):
                return f"{self._plan.cast[role].name}: {hosts.REBOOTED}"
        return None

    def check_alive(self) -> None:
        """Raise the error of `Transient.check_alive` if a process that the robots need has exited."""
        if isinstance(self._testbed, Transient):
            self._testbed.check_alive()

    def require_locks(self) -> None:
        """Raise an error if a robot reports that this trial no longer holds its lock.

        Robots that do not answer are ignored.

        Raises:
            LockLostError: The trial was aborted, or the lock expired and another holder locked the robot.
        """

        def check_lock(role: Role) -> None:
            try:
                locks.require_lock(self.shells[role], self._plan.session)
            except LockLostError:
                raise
            except FieldkitError:
                return  # the attempt is void for other reasons

        self._run_on_all(check_lock)

    def stop_jobs(self, remote: str) -> None:
        """Stop all jobs of an attempt. Raises the same errors as `evidence.end_jobs`."""
        self._run_on_all(lambda role: evidence.end_jobs(self.shells[role], remote))

    def stop_leftover_jobs(self) -> None:
        """Stop all jobs of this trial that a killed run left on the robots.

        Raises the same errors as `evidence.end_all`.
        """

        def stop(role: Role) -> None:
            jobs.install(self.shells[role], Deadline.after(jobs.REPLY_S))
            evidence.end_all(self.shells[role], self._plan.trial)

        self._run_on_all(stop)

    def close_connections(self) -> None:
        """Close all control connections and cancel fetching. The next command opens a new connection."""
        self._is_fetch_cancelled = True
        for shell in self.shells.values():
            shell.close()

    def delete_remote(self, remote: str | None = None) -> None:
        """Remove the folder of an attempt or, if `remote` is None, of the trial from the robots.

        Evidence that was not fetched is kept.

        Raises:
            FieldkitError: For the same reasons as `evidence.discard`.
        """

        def remove(role: Role) -> None:
            unfetched_folders = self.unfetched.folders[role]
            if remote is None:
                evidence.discard(self.shells[role], self._plan.trial, kept_folders=unfetched_folders)
            elif remote not in unfetched_folders:
                evidence.discard_attempt(self.shells[role], remote)

        self._run_on_all(remove)

    def _interface(self, role: Role) -> str:
        return self._plan.cast[role].profile.radio.interface

    def _run_on_all(self, call: Callable[[Role], T]) -> list[T]:
        return run_parallel(call, self._roles, on_interrupt=self.close_connections)
