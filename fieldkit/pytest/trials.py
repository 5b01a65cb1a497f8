"""Complete trials in tests. They run like those of `fieldkit trial`, and are returned as by `fieldkit.load`."""

import argparse
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Final

from fieldkit.analysis.judgement_words import judgement_texts
from fieldkit.analysis.judgements import Judgement
from fieldkit.api.trials import Trials, load
from fieldkit.backends.protocols import simulators_of
from fieldkit.cli import cli_options as command_line
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.model import Protocol, Topology
from fieldkit.core.units import format_count, parse_distance
from fieldkit.pytest.lab_fixture import OpenedLab
from fieldkit.pytest.plugin_options import one_of
from fieldkit.trial import store
from fieldkit.trial.request import make_plan
from fieldkit.trial.running import runner
from fieldkit.trial.running.runner import Outcome

FOLDER: Final = "trials"
"""Folder of a test's trials in its evidence."""


class ExpectationError(AssertionError):
    """A figure does not meet an expectation of the procedure."""


class TrialRunner:
    """Runs trials on the robots of a lab.

    Args:
        lab: The lab.
    """

    def __init__(self, lab: OpenedLab) -> None:
        self._lab = lab

    def __call__(
        self,
        procedure: str,
        distance: str,
        *,
        topology: str | None = None,
        protocol: str | Iterable[str] = (),
        repeats: int | None = None,
        record: str | None = None,
        notes: str = "",
    ) -> Trials:
        """Run a trial and return it with all its evidence. The arguments are the options of `fieldkit trial`.

        Args:
            procedure: Name of the procedure.
            distance: Distance of the robots: `30ft`.
            topology: `master` or `masterless`; None for the topology of the options, or else of the procedure. Open
                robots of another topology are closed.
            protocol: `tcp`, `udp`, or both; empty for the protocols of the procedure.
            repeats: Repeats per protocol; None for the procedure's value.
            record: Duration of each recording: `2s`; None for the procedure's value.
            notes: Notes in the trial's plan.

        Raises:
            ExpectationError: All repeats are valid, but a figure does not meet an expectation of the procedure.
            ConfigurationError: An argument is wrong.
            EvidenceError: A repeat failed.
            FieldkitError: For the same reasons as `OpenedLab.open` and `runner.run_trial`.
        """
        __tracebackhide__ = True
        protocols = (protocol,) if isinstance(protocol, str) else tuple(protocol)
        topology_name = topology or self._lab.options.topology
        arguments = argparse.Namespace(
            procedure=procedure,
            topology=topology_name and one_of(Topology, topology_name, "topology"),
            protocol=[one_of(Protocol, name, "protocol") for name in protocols],
            repeats=_require_positive(repeats),
            record=record,
        )
        request = command_line.request(arguments, parse_distance(distance), seed=self._lab.options.seed, notes=notes)
        testbed = self._lab.open(request.effective_topology)
        plan = make_plan(
            request,
            backend=self._lab.backend_name,
            cast=self._lab.cast,
            now=datetime.now(UTC),
            session=self._lab.session,
            lab_bytes=self._lab.backend.lab_bytes,
            simulators=simulators_of(self._lab.backend),
        )
        out = self._lab.keeper.folder.path / FOLDER
        store.prepare(out)
        outcome = runner.run_trial(plan, testbed, out, self._lab.keeper.add_event)
        assert outcome is not None, "a trial in a test cannot be skipped"
        return _load_checked(outcome)


def _require_positive(repeats: int | None) -> int | None:
    if repeats is not None and repeats < 1:
        raise ConfigurationError(f"{repeats} repeats measure nothing", remedy="write for example repeats=2")
    return repeats


def _load_checked(outcome: Outcome) -> Trials:
    __tracebackhide__ = True
    if outcome.failed:
        raise EvidenceError(
            f"{format_count(outcome.failed, 'repeat')} failed; reasons in {store.TRIAL_CSV}",
            where=str(outcome.folder),
            remedy="see its log; to find what the robots lack: fieldkit check",
        )
    _require_expected(outcome.judgements)
    return load(outcome.folder)


def _require_expected(judgements: Sequence[Judgement]) -> None:
    __tracebackhide__ = True
    unmet = [" ".join(filter(None, judgement_texts(judgement))) for judgement in judgements if not judgement.holds]
    if unmet:
        raise ExpectationError("; ".join(unmet))
