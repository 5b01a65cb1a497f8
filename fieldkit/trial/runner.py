"""Run a planned trial: every repeat attempted, its evidence fetched, judged, kept and journalled."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fieldkit.analysis.summary import CellRow
from fieldkit.backends import Lab
from fieldkit.columns import RepeatRow
from fieldkit.errors import EvidenceError, FieldkitError, LinkError, RobotError
from fieldkit.events import Note, PhaseStarted, RepeatEnded, Sink, TrialEnded
from fieldkit.model import RepeatId, Role, Status
from fieldkit.remote import evidence, jobs
from fieldkit.steps.base import together
from fieldkit.trial import gates, journal, preflight, rows, store
from fieldkit.trial.journal import Attempt, Entry
from fieldkit.trial.plan import Plan


@dataclass(frozen=True)
class Outcome:
    """What a trial came to.

    Attributes:
        folder: Its folder.
        cells: Its summary.
        valid: Repeats that are valid.
        failed: Repeats that no attempt made valid.
    """

    folder: Path
    cells: tuple[CellRow, ...]
    valid: int
    failed: int


def run_trial(plan: Plan, lab: Lab, out: Path, sink: Sink) -> Outcome:
    """Place the robots, check them, and run every repeat.

    Whatever ends the trial early, the folder holds the plan, the journal, every attempt that had ended, their rows
    and a manifest over them; only a kill leaves out the summary, which `rebuild` makes.

    Args:
        plan: The trial.
        lab: The robots.
        out: Folder that the trial's own folder is made in.
        sink: Told what happens.

    Raises:
        ConfigurationError: The folder cannot be made.
        LinkError: A robot did not answer before repeat 1.
        RobotError: Preflight found a problem.
    """
    folder = store.create(out, plan)
    sink(Note(f"trial {folder}"))
    lab.place(plan.placement)
    sink(PhaseStarted("preflight"))
    findings = preflight.preflight(plan, lab.shells)
    text = "".join(f"{one.robot}\t{one.check}\t{one.detail}\t{one.remedy}\n" for one in findings)
    store.write(folder / store.PREFLIGHT_FILE, text.encode())
    preflight.demand(findings)
    return _Trial(plan, lab, folder, sink).run()


class _Trial:
    """The state of a running trial: its rows so far, and how long its repeats take."""

    def __init__(self, plan: Plan, lab: Lab, folder: Path, sink: Sink) -> None:
        self._plan = plan
        self._shells = lab.shells
        self._folder = folder
        self._sink = sink
        self._roles = sorted(plan.procedure.roles())
        self._manifest = store.Manifest(folder)
        self._rows: list[RepeatRow] = []
        self._last_remote = ""
        self._started_s = time.monotonic()

    def run(self) -> Outcome:
        repeats = list(self._plan.order())
        now = time.time_ns()
        planned = (Entry(now, repeat.protocol, repeat.number, 0, Status.PLANNED) for repeat in repeats)
        journal.append(self._folder, *planned)
        valid = 0
        try:
            for done, repeat in enumerate(repeats, start=1):
                valid += self._repeat(repeat, done, len(repeats))
        finally:
            cells = self._summarize()
        for role in self._roles:
            evidence.discard(self._shells[role], self._plan.trial)
        void = sum(row.status == Status.VOID for row in self._rows)
        failed = len(repeats) - valid
        self._sink(TrialEnded(str(self._folder), valid, void, failed))
        return Outcome(self._folder, cells, valid, failed)

    def _repeat(self, repeat: RepeatId, done: int, total: int) -> bool:
        for number in range(1, self._plan.procedure.attempts + 1):
            last = number == self._plan.procedure.attempts
            attempt = self._attempt(repeat, number, bad=Status.FAILED if last else Status.VOID)
            over = last or attempt.status is Status.VALID
            self._sink(
                RepeatEnded(
                    repeat=str(repeat),
                    attempt=number,
                    status=attempt.status,
                    reason=attempt.reason,
                    summary=_in_words(self._rows[-1]),
                    done=done if over else done - 1,
                    total=total,
                    left_s=(time.monotonic() - self._started_s) / done * (total - done),
                )
            )
            if attempt.status is Status.VALID:
                return True
        return False

    def _attempt(self, repeat: RepeatId, number: int, *, bad: Status) -> Attempt:
        started = time.time_ns()
        journal.append(self._folder, Entry(started, repeat.protocol, repeat.number, number, Status.RUNNING))
        self._manifest.write()
        partial = store.open_attempt(self._folder, repeat)
        remote = jobs.work_folder(self._plan.trial, f"{repeat}-{number}")
        reasons: list[str] = []
        try:
            self._steps(repeat, remote)
        except (RobotError, LinkError, EvidenceError) as error:
            reasons.append(_sentence(error))
        except BaseException:
            # A robot that cannot be reached now ends its jobs at their own limits.
            with suppress(FieldkitError):
                self._everywhere(lambda role: evidence.end_jobs(self._shells[role], remote))
            self._keep(partial, Attempt(repeat, number, started, Status.VOID, "interrupted"))
            raise
        self._sink(PhaseStarted("collect evidence", str(repeat)))
        reasons += self._fetch(remote, partial, clean=not reasons)
        reasons = reasons or list(gates.problems(self._plan, partial))
        attempt = Attempt(repeat, number, started, bad if reasons else Status.VALID, "; ".join(reasons))
        self._keep(partial, attempt)
        self._last_remote = remote
        return attempt

    def _steps(self, repeat: RepeatId, remote: str) -> None:
        scene = self._plan.scene(repeat, remote)
        old = self._last_remote or None

        def announce(name: str, expected_s: float | None) -> None:
            self._sink(PhaseStarted(name, str(repeat), expected_s))

        self._everywhere(
            lambda role: evidence.begin(
                self._shells[role], remote, role, scene.robot(role).profile.radio.interface, old=old
            )
        )
        for entry in self._plan.procedure.steps:
            entry.step.run(scene, self._shells, announce)

    def _fetch(self, remote: str, into: Path, *, clean: bool) -> list[str]:
        """Collect the evidence of an attempt, of one that broke too; return what went wrong."""
        cast = self._plan.cast

        def collect(role: Role) -> str:
            try:
                if not clean:
                    evidence.end_jobs(self._shells[role], remote)
                evidence.fetch(self._shells[role], remote, role, cast[role].profile.radio.interface, into)
            except (RobotError, LinkError, EvidenceError) as error:
                return _sentence(error)
            return ""

        return [reason for reason in self._everywhere(collect) if reason]

    def _keep(self, partial: Path, attempt: Attempt) -> None:
        """Bring an attempt to disk: evidence first, then the journal's word on it, then what is derived."""
        final = store.keep_attempt(partial, attempt.folder)
        repeat = attempt.repeat
        journal.append(
            self._folder,
            Entry(time.time_ns(), repeat.protocol, repeat.number, attempt.number, attempt.status, attempt.reason),
        )
        self._rows.append(rows.build(self._plan, attempt, final))
        rows.write_rows(self._folder, self._rows)
        self._manifest.add(final)
        self._manifest.write()

    def _summarize(self) -> tuple[CellRow, ...]:
        cells = rows.write_summary(self._folder, self._plan, self._rows)
        self._manifest.write()
        return cells

    def _everywhere(self, call: Callable[[Role], str | None]) -> list[str | None]:
        return together(*(lambda role=role: call(role) for role in self._roles))


def _sentence(error: FieldkitError) -> str:
    return f"{error.where}: {error.what}" if error.where else error.what


def _in_words(row: RepeatRow) -> str:
    layers = {"IP loss": row.ip_loss, "datagram loss": row.datagram_loss, "file loss": row.file_loss}
    parts = [f"{name} {100 * share:.1f} %" for name, share in layers.items() if share is not None]
    if row.tcp_retransmitted_segments is not None:
        parts.append(f"{row.tcp_retransmitted_segments} retransmitted")
    if row.rtt_median_s is not None:
        parts.append(f"RTT {1e3 * row.rtt_median_s:.1f} ms")
    return ", ".join(parts)
