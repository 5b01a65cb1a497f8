"""Run or resume a campaign: each trial once; trials that the operator skips are offered again at the end."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Backend, Cast, Testbed, simulators_of
from fieldkit.campaign.journal import CampaignJournal, TrialProgress
from fieldkit.campaign.order import PlannedTrial, walk_m
from fieldkit.campaign.plan import CampaignPlan
from fieldkit.core import files, seeds
from fieldkit.core.campaign_events import CampaignEnded, CampaignPlanned, CampaignTrial, CampaignWent
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.events import Note, Sink
from fieldkit.core.model import Topology
from fieldkit.core.prompts import Operator
from fieldkit.core.units import TimeEstimate, format_bytes
from fieldkit.trial import estimates, journal
from fieldkit.trial.check import shortfalls
from fieldkit.trial.estimates import FinishedRepeat
from fieldkit.trial.plan import Plan
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.opening import opened
from fieldkit.trial.running.resumption import continue_trial, require_cast, resumable
from fieldkit.trial.running.runner import begin, place
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.size import trial_bytes

PLACING_S: Final = 60.0
"""Assumed duration of carrying the robots to a place until the first duration was measured."""


@dataclass(frozen=True)
class CampaignOutcome:
    """Result of a campaign.

    Attributes:
        remaining: Trials that have not ended.
        failed: Number of failed repeats in the trials that have ended.
        unmet: Number of expectations that are not met or undecided.
        folders: Folders of the trials that have ended.
    """

    remaining: tuple[PlannedTrial, ...]
    failed: int
    unmet: int
    folders: tuple[Path, ...]


class CampaignRun:
    """A campaign with its robots.

    Args:
        plan: Its frozen plan.
        journal: Its journal.
        backend: The backend.
        sink: Receives events.
        failed: Whether failed repeats of trials that have ended are repeated.

    Raises:
        ConfigurationError: A trial lacks a robot for a role.
    """

    def __init__(
        self, plan: CampaignPlan, journal: CampaignJournal, backend: Backend, sink: Sink, *, failed: bool = False
    ) -> None:
        self._plan = plan
        self._journal = journal
        self._backend = backend
        self._failed = self._includes_failed = failed
        self._sink = sink
        self._trials = plan.trials()
        self._set_up_topology: Topology | None = None
        self._set_up_note = ""
        self._plans = {trial: self._trial_plan(trial, backend.cast(trial.topology)) for trial in self._trials}

    def announce(self) -> None:
        """Report the remaining work, reduced settings of the procedures, and expectations that cannot be decided."""
        remaining = self._remaining_trials()
        needed_bytes, free_bytes = self._needed_and_free_bytes(remaining)
        duration = self._estimate(remaining)
        self._sink(
            CampaignPlanned(
                name=self._plan.campaign.name,
                trials=tuple(map(str, remaining)),
                needed_bytes=needed_bytes,
                free_bytes=free_bytes,
                done=len(self._trials) - len(remaining),
                total=len(self._trials),
                walk_m=walk_m(remaining),
                left_s=duration.likely_s,
                left_most_s=duration.most_s,
            )
        )
        adjustment_lines = (
            line for trial in remaining for line in self._plan.procedure(trial).adjustments(self._plans[trial].cast)
        )
        shortfall_lines = (
            line for trial in remaining for line in shortfalls.undecidable_expectations(self._plans[trial])
        )
        for line in dict.fromkeys((*adjustment_lines, *shortfall_lines)):
            self._sink(Note(line))

    def run(self, operator: Operator, stop: Stop) -> CampaignOutcome:
        """Run the remaining trials; skipped trials are offered again after the others.

        Args:
            operator: Sets up and places the robots.
            stop: Request to stop the campaign.

        Raises:
            ConfigurationError: The folder cannot be written or has too little space, or an interrupted trial cannot
                be resumed.
            LinkError: A robot did not answer.
            RobotError: A robot does not meet the requirements of a trial.
            KeyboardInterrupt: A stop was requested.
        """
        with self._journal.locked(self._plan):
            try:
                self._require_space()
                self._restart_failed()
                self._run_trials(self._remaining_trials(), operator, stop)
                # Only skipped trials remain; this does nothing if there are none.
                self._run_trials(self._remaining_trials(), operator, stop)
            finally:
                done = len(self._trials) - len(self._remaining_trials())
                self._sink(CampaignEnded(str(self._journal.folder), done, len(self._trials)))
        end_entries = self._journal.end_entries().values()
        failed, unmet = (sum(getattr(entry, field) for entry in end_entries) for field in ("failed", "unmet"))
        folders = tuple(self._journal.folder / entry.trial for entry in end_entries)
        return CampaignOutcome(self._remaining_trials(), failed, unmet, folders)

    def _run_trials(self, trials: Sequence[PlannedTrial], operator: Operator, stop: Stop) -> None:
        """Run trials in order. Consecutive trials of one topology use the robots without reopening them."""
        for topology, block in groupby(trials, key=lambda trial: trial.topology):
            topology_trials = list(block)
            cast = {role: robot for trial in topology_trials for role, robot in self._plans[trial].cast.items()}
            self._set_up(topology, cast, operator)
            attempts = sum(map(journal.started_attempts, self._journal.folder.glob("*/")))
            with opened(
                self._backend,
                cast,
                session=self._plan.session,
                purpose=f"campaign {self._plan.campaign.name}",
                seed=seeds.testbed_seed(self._plan.campaign.seed, attempts),
                sink=self._sink,
                operator=operator,
            ) as testbed:
                for trial in topology_trials:
                    self._run(trial, cast, testbed, stop)

    def _set_up(self, topology: Topology, cast: Cast, operator: Operator) -> None:
        """Ask the operator to set the robots up if the topology changes and people set them up."""
        if self._backend.by_hand and self._set_up_topology not in {None, topology}:
            roles = ", ".join(f"{robot.name} as {role}" for role, robot in cast.items())
            self._set_up_note = operator.ask(f"set the robots up for topology {topology}: {roles}").note
        self._set_up_topology = topology

    def _run(self, trial: PlannedTrial, cast: Cast, testbed: Testbed, stop: Stop) -> None:
        """Place the robots, then run or resume the trial, unless the operator skips it."""
        total = len(self._trials)
        self._sink(CampaignTrial(str(trial), total - len(self._remaining_trials()) + 1, total))
        folder = self._journal.interrupted_folder(trial)
        if folder is None:
            plan = self._trial_plan(trial, cast)
            self._journal.add(trial, TrialProgress.STARTED, trial=plan.trial)
        else:
            plan = resumable(folder)
            require_cast(plan, cast)
        placement = place(plan, testbed, self._sink)
        progress = TrialProgress.SKIPPED if placement.answer.skip else TrialProgress.PLACED
        self._journal.add(trial, progress, note=placement.answer.note, took_s=placement.duration_s)
        if not placement.answer.skip:
            # A stopped trial is resumed by the campaign's command, so `report_resume` is False.
            if folder is None:
                plan = plan.with_note(placement.answer.note)
                outcome = begin(plan, testbed, self._journal.folder, self._sink, stop, report_resume=False)
            else:
                outcome = continue_trial(folder, testbed, self._sink, stop, report_resume=False, failed=self._failed)
            trial_name, valid, failed = outcome.folder.name, outcome.valid, outcome.failed
            unmet = sum(not judgement.holds for judgement in outcome.judgements)
            self._journal.add(trial, TrialProgress.ENDED, trial=trial_name, valid=valid, failed=failed, unmet=unmet)
        remaining = self._remaining_trials()
        duration = self._estimate(remaining)
        self._sink(CampaignWent(str(trial), total - len(remaining), total, duration.likely_s, duration.most_s))

    def _restart_failed(self) -> None:
        """Record a new start of each trial whose failed repeats must be repeated."""
        end_entries = self._journal.end_entries()
        for trial in self._remaining_trials():
            if entry := end_entries.get(str(trial)):
                self._journal.add(trial, TrialProgress.STARTED, trial=entry.trial)
        self._includes_failed = False

    def _remaining_trials(self) -> tuple[PlannedTrial, ...]:
        """Return the trials that have not ended. Before `_restart_failed`, this includes ended trials to repeat."""
        ended_names = {
            name
            for name, entry in self._journal.end_entries().items()
            if not (self._includes_failed and entry.failed)
        }
        return tuple(trial for trial in self._trials if str(trial) not in ended_names)

    def _needed_and_free_bytes(self, trials: Sequence[PlannedTrial]) -> tuple[int, int]:
        """Return the bytes that trials need, and the bytes that are free in the campaign's folder."""
        return sum(trial_bytes(self._plans[trial]) for trial in trials), files.free_bytes(self._journal.folder)

    def _require_space(self) -> None:
        needed_bytes, free_bytes = self._needed_and_free_bytes(self._remaining_trials())
        if free_bytes < needed_bytes:
            raise ConfigurationError(
                f"the evidence may need {format_bytes(needed_bytes)}, {format_bytes(free_bytes)} are free",
                where=str(self._journal.folder),
                remedy="free some space, or choose another --out",
            )

    def _estimate(self, trials: Sequence[PlannedTrial]) -> TimeEstimate:
        """Return the estimated duration of trials, based on the finished ones."""
        placing_s = self._journal.placing_s(PLACING_S if self._backend.by_hand else 0.0)
        placement = TimeEstimate(placing_s, placing_s)
        finished_repeats = self._finished_repeats()
        return estimates.total(
            part
            for trial in trials
            for part in (placement, estimates.estimate_trial(self._plans[trial], finished_repeats))
        )

    def _finished_repeats(self) -> list[FinishedRepeat]:
        """Return the finished repeats of trials that have ended; trials with unreadable journals are ignored."""
        finished_repeats: list[FinishedRepeat] = []
        for name, entry in self._journal.end_entries().items():
            plan = next((self._plans[trial] for trial in self._trials if str(trial) == name), None)
            with suppress(EvidenceError):
                finished_repeats += (
                    []
                    if plan is None
                    else estimates.finished_repeats(plan, journal.read(self._journal.folder / entry.trial))
                )
        return finished_repeats

    def _trial_plan(self, trial: PlannedTrial, cast: Cast) -> Plan:
        campaign = self._plan.campaign
        request = TrialRequest(
            procedure=self._plan.procedure(trial),
            distance=trial.distance,
            topology=trial.topology,
            protocols=campaign.protocols,
            repeats=campaign.repeats,
            record_s=campaign.record,
            seed=campaign.seed,
            notes=f"campaign {campaign.name}",
        )
        plan = make_plan(
            request,
            backend=self._plan.backend,
            cast=cast,
            now=datetime.now(UTC),
            session=self._plan.session,
            lab_bytes=self._backend.lab_bytes,
            simulators=simulators_of(self._backend),
        )
        return plan.with_note(self._set_up_note)
