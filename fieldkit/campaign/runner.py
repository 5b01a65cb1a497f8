"""Run a campaign, or go on with one: each trial once, those that the operator skips offered again at the end."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Backend, Cast, Testbed
from fieldkit.campaign.journal import CampaignJournal, TrialProgress
from fieldkit.campaign.order import PlannedTrial, walk_m
from fieldkit.campaign.plan import CampaignPlan
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.events import CampaignEnded, CampaignPlanned, CampaignTrial, CampaignWent, Note, Sink
from fieldkit.core.model import Topology
from fieldkit.core.prompts import Operator
from fieldkit.core.units import TimeEstimate, format_bytes
from fieldkit.trial import estimates, journal
from fieldkit.trial.estimates import Taken
from fieldkit.trial.plan import Plan
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.opening import opened
from fieldkit.trial.running.resumption import demand_cast, resumable
from fieldkit.trial.running.runner import begin, go_on, place
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.size import trial_bytes

PLACING_S: Final = 60.0
"""How long a person is assumed to carry robots to a place, before the first was timed."""


@dataclass(frozen=True)
class CampaignOutcome:
    """What a campaign came to.

    Attributes:
        left: Trials that are not over.
        failed: Repeats that failed in those that are.
        unmet: Expectations that their figures do not show to hold.
        folders: Folders of those that are.
    """

    left: tuple[PlannedTrial, ...]
    failed: int
    unmet: int
    folders: tuple[Path, ...]


class CampaignRun:
    """A campaign with its robots.

    Args:
        plan: What it was begun with.
        journal: What became of its trials so far.
        backend: Where its robots come from.
        sink: Told what happens.
        failed: Whether failed repeats of trials that are over are redone.

    Raises:
        ConfigurationError: A trial lacks a robot for a role.
    """

    def __init__(
        self, plan: CampaignPlan, journal: CampaignJournal, backend: Backend, sink: Sink, *, failed: bool = False
    ) -> None:
        self._plan = plan
        self._journal = journal
        self._backend = backend
        self._failed = self._redoes = failed
        self._sink = sink
        self._trials = plan.trials()
        self._rigged: Topology | None = None
        self._rig_note = ""
        self._plans = {trial: self._trial_plan(trial, backend.cast(trial.topology)) for trial in self._trials}

    def announce(self) -> None:
        """Tell what there is to be done, and what of it is less than the procedures ask for."""
        left = self._left()
        needed_bytes, free_bytes = self._room(left)
        lasts = self._lasts(left)
        self._sink(
            CampaignPlanned(
                name=self._plan.campaign.name,
                trials=tuple(map(str, left)),
                needed_bytes=needed_bytes,
                free_bytes=free_bytes,
                done=len(self._trials) - len(left),
                total=len(self._trials),
                walk_m=walk_m(left),
                left_s=lasts.likely_s,
                left_most_s=lasts.most_s,
            )
        )
        shortened = (
            line for trial in left for line in self._plan.procedure(trial).adjustments(self._plans[trial].cast)
        )
        shortfalls = (line for trial in left for line in self._plans[trial].shortfalls())
        for line in dict.fromkeys((*shortened, *shortfalls)):
            self._sink(Note(line))

    def run(self, operator: Operator, stop: Stop) -> CampaignOutcome:
        """Run what is left; trials that are skipped are offered once more after the others.

        Args:
            operator: Rigs and places the robots.
            stop: Tells the campaign to stop.

        Raises:
            ConfigurationError: The folder cannot be written or has too little room, or an interrupted trial cannot
                be gone on with.
            LinkError: A robot did not answer.
            RobotError: A robot cannot do what a trial needs.
            KeyboardInterrupt: `stop` was asked for.
        """
        with self._journal.kept(self._plan):
            try:
                self._demand_room()
                self._reopen()
                self._offer(self._left(), operator, stop)
                # All that were skipped are left; without any, nothing is.
                self._offer(self._left(), operator, stop)
            finally:
                done = len(self._trials) - len(self._left())
                self._sink(CampaignEnded(str(self._journal.folder), done, len(self._trials)))
        ended = self._journal.ended().values()
        failed, unmet = (sum(getattr(entry, what) for entry in ended) for what in ("failed", "unmet"))
        folders = tuple(self._journal.folder / entry.trial for entry in ended)
        return CampaignOutcome(self._left(), failed, unmet, folders)

    def _offer(self, trials: Sequence[PlannedTrial], operator: Operator, stop: Stop) -> None:
        for topology, block in groupby(trials, key=lambda trial: trial.topology):
            trials_of_it = list(block)
            cast = {role: robot for trial in trials_of_it for role, robot in self._plans[trial].cast.items()}
            self._rig(topology, cast, operator)
            with opened(
                self._backend,
                cast,
                session=self._plan.session,
                what=f"campaign {self._plan.campaign.name}",
                seed=self._plan.campaign.seed,
                sink=self._sink,
                operator=operator,
            ) as testbed:
                for trial in trials_of_it:
                    self._run(trial, cast, testbed, stop)

    def _rig(self, topology: Topology, cast: Cast, operator: Operator) -> None:
        if self._backend.by_hand and self._rigged not in {None, topology}:
            roles = ", ".join(f"{robot.name} as {role}" for role, robot in cast.items())
            self._rig_note = operator.ask(f"set the robots up for topology {topology}: {roles}").note
        self._rigged = topology

    def _run(self, trial: PlannedTrial, cast: Cast, testbed: Testbed, stop: Stop) -> None:
        total = len(self._trials)
        self._sink(CampaignTrial(str(trial), total - len(self._left()) + 1, total))
        folder = self._journal.interrupted(trial)
        if folder is None:
            plan = self._trial_plan(trial, cast)
            self._journal.add(trial, TrialProgress.STARTED, trial=plan.trial)
        else:
            plan = resumable(folder)
            demand_cast(plan, cast)
        placing = place(plan, testbed, self._sink)
        progress = TrialProgress.SKIPPED if placing.answer.skip else TrialProgress.PLACED
        self._journal.add(trial, progress, note=placing.answer.note, took_s=placing.took_s)
        if not placing.answer.skip:
            # A trial that stops is gone on with by the campaign's own command.
            if folder is None:
                plan = plan.with_note(placing.answer.note)
                outcome = begin(plan, testbed, self._journal.folder, self._sink, stop, told=False)
            else:
                outcome = go_on(folder, testbed, self._sink, stop, told=False, failed=self._failed)
            trial_name, valid, failed = outcome.folder.name, outcome.valid, outcome.failed
            unmet = sum(not judgement.holds for judgement in outcome.judgements)
            self._journal.add(trial, TrialProgress.ENDED, trial=trial_name, valid=valid, failed=failed, unmet=unmet)
        left = self._left()
        lasts = self._lasts(left)
        self._sink(CampaignWent(str(trial), total - len(left), total, lasts.likely_s, lasts.most_s))

    def _reopen(self) -> None:
        """Enter that trials with failed repeats begin once more, if these are redone."""
        over = self._journal.ended()
        for trial in self._left():
            if entry := over.get(str(trial)):
                self._journal.add(trial, TrialProgress.STARTED, trial=entry.trial)
        self._redoes = False

    def _left(self) -> tuple[PlannedTrial, ...]:
        """Return the trials that are not over, and with `--failed`, until `_reopen`, those with failed repeats."""
        over = {name for name, entry in self._journal.ended().items() if not (self._redoes and entry.failed)}
        return tuple(trial for trial in self._trials if str(trial) not in over)

    def _room(self, trials: Sequence[PlannedTrial]) -> tuple[int, int]:
        """Return how many bytes trials need, and how many are free where they go."""
        return sum(trial_bytes(self._plans[trial]) for trial in trials), files.free_bytes(self._journal.folder)

    def _demand_room(self) -> None:
        needed_bytes, free_bytes = self._room(self._left())
        if free_bytes < needed_bytes:
            raise ConfigurationError(
                f"the evidence may need {format_bytes(needed_bytes)}, {format_bytes(free_bytes)} are free",
                where=str(self._journal.folder),
                remedy="free some space, or choose another --out",
            )

    def _lasts(self, trials: Sequence[PlannedTrial]) -> TimeEstimate:
        """TimeEstimate how long trials take, by what those took that are over."""
        placing_s = self._journal.placing_s(PLACING_S if self._backend.by_hand else 0.0)
        placing = TimeEstimate(placing_s, placing_s)
        known = self._known()
        return estimates.total(
            part for trial in trials for part in (placing, estimates.of_trial(self._plans[trial], known))
        )

    def _known(self) -> list[Taken]:
        """Return what the repeats of trials took that are over; a journal that cannot be read says nothing here."""
        known: list[Taken] = []
        for name, entry in self._journal.ended().items():
            plan = next((self._plans[trial] for trial in self._trials if str(trial) == name), None)
            with suppress(EvidenceError):
                known += (
                    [] if plan is None else estimates.taken(plan, journal.read(self._journal.folder / entry.trial))
                )
        return known

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
        )
        return plan.with_note(self._rig_note)
