"""The command `fieldkit cosim satisfy`: it repeats a run with other windows until the loss is satisfactory.

This is the satisfaction loop of the paper (cited in docs/index.md).
"""

import argparse
from functools import partial
from typing import Final

from fieldkit.cli.display import show_note, showing_progress
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count, parse_quantity
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, number_text
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.satisfaction import Satisfaction, satisfy

NOT_SATISFIED: Final = 1
"""Exit code if no round was satisfactory."""

_COLUMNS: Final = (
    SheetColumn("round", "round", ""),
    SheetColumn("window_s", "w (ms)", "parameter w of the rule", 1e3),
    SheetColumn("median_window_s", "median (ms)", "median of the windows of the round", 1e3),
    SheetColumn("loss", "lost (%)", "lost packets as a share of those whose fate is decided", 100),
    SheetColumn("fate_disagreement", "fate (%)", "lost in this run or in the reference, but not in both", 100),
    SheetColumn(
        "delivery_error_mean_s",
        "time (ms)",
        "mean absolute difference from the delivery time in the reference",
        1e3,
    ),
    SheetColumn("position_error_mean_m", "position (mm)", "mean error of relative positions in the network", 1e3),
    SheetColumn("exchanges", "exchanges", "number of windows of the round"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run rounds until a round is satisfactory, and print the errors of each round against the exact reference.

    Raises:
        ConfigurationError: The scenario is invalid, or the threshold is not a share of at most 100 %.
    """
    scenario = settings.read_scenario(arguments)
    threshold = parse_quantity(arguments.threshold, {"%": 0.01}, "threshold")
    if threshold > 1:
        raise ConfigurationError(
            f"--threshold: {arguments.threshold} is above 100 %", remedy="write for example --threshold 10%"
        )
    seed = scenario.seeds[0] if arguments.seed is None else arguments.seed
    build(without_federates(scenario))  # raises before any run if the scenario is invalid
    settings.note_commensurate_events(scenario, [arguments.policy], [scenario.policy.window], 1)
    with showing_progress() as sink:
        report = partial(progress_reporter(sink), "satisfy", arguments.rounds + 1)
        satisfaction = satisfy(
            _CountedRuns(scenario, seed, report),
            lambda window_s: make_policy(
                arguments.policy, window_s=window_s, longest_s=max(window_s, scenario.policy.longest)
            ),
            threshold=threshold,
            window_s=scenario.policy.window,
            max_rounds=arguments.rounds,
        )
    title = f"{scenario.name}, {scenario.topology}, {arguments.policy}, seed {seed}: the satisfaction loop"
    _sheet(title, satisfaction).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        print_text(_summary(satisfaction, threshold))
    if not satisfaction.is_satisfied:
        show_note(f"no round was satisfactory: {satisfaction.reason}")
    return 0 if satisfaction.is_satisfied else NOT_SATISFIED


class _CountedRuns:
    """Runs the same scenario and seed with different policies, and reports the number of earlier runs before each."""

    def __init__(self, scenario: CosimScenario, seed: int, report: partial[None]) -> None:
        self._scenario = scenario
        self._seed = seed
        self._report = report
        self._finished_runs = 0

    def __call__(self, policy: SyncPolicy) -> Run:
        self._report(self._finished_runs)
        self._finished_runs += 1
        with build(self._scenario, policy=policy, seed=self._seed, measures_all=True) as simulation:
            return simulation.run()


def _sheet(title: str, satisfaction: Satisfaction) -> Sheet:
    rows = [
        (
            index,
            round_.window_s,
            round_.median_window_s,
            round_.loss,
            round_.errors.fate_disagreement,
            round_.errors.delivery_error_s.mean,
            round_.errors.position_error_m.mean,
            round_.exchanges,
        )
        for index, round_ in enumerate(satisfaction.rounds, start=1)
    ]
    return Sheet(_COLUMNS, rows, [SheetPart(title, [column.name for column in _COLUMNS])])


def _summary(satisfaction: Satisfaction, threshold: float) -> str:
    reference_percent = number_text(100 * satisfaction.reference_loss)
    reference = f"the loss of the exact reference is {reference_percent} %, independently of the window"
    lines = [f"{reference}; it needs {satisfaction.reference_exchanges:,} exchanges"]
    if satisfaction.rounds:
        last_round = satisfaction.rounds[-1]
        rounds = format_count(len(satisfaction.rounds), "round")
        outcome = "accepted" if satisfaction.is_satisfied else "not accepted"
        loss_percent, threshold_percent = (number_text(100 * share) for share in (last_round.loss, threshold))
        lines.append(
            f"after {rounds} and {satisfaction.exchanges:,} exchanges, the loss of {loss_percent} % is {outcome} "
            f"(threshold {threshold_percent} %)"
        )
    return "\n".join(lines)
