"""`fieldkit cosim satisfy SCENARIO`: the paper's satisfaction loop, and what it changes: error and cost, not loss."""

import argparse
from functools import partial
from typing import Final

from fieldkit.cli.display import show_note, working
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.printing import say
from fieldkit.core.units import format_count, parse_quantity
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, number
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.policies import make_policy
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.satisfaction import Satisfaction, satisfy

MISSED: Final = 1
"""Exit code where no round was satisfactory."""

_COLUMNS: Final = (
    SheetColumn("round", "round", ""),
    SheetColumn("window_s", "w (ms)", "window that it began with", 1e3),
    SheetColumn("median_window_s", "made (ms)", "median of the windows that the rule made of it", 1e3),
    SheetColumn("loss", "lost (%)", "of packets whose fate is known", 100),
    SheetColumn("fate_disagreement", "fate (%)", "lost here or in the reference, but not in both", 100),
    SheetColumn("delivery_error_mean_s", "time (ms)", "delivery time less the reference's, magnitude, mean", 1e3),
    SheetColumn("position_error_mean_m", "place (mm)", "how wrong the network was about two agents, mean", 1e3),
    SheetColumn("exchanges", "exchanges", "what it cost"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run rounds until one is satisfactory, and print each beside the exact reference.

    Raises:
        ConfigurationError: The threshold is no share.
    """
    scenario = settings.scenario(arguments)
    threshold = parse_quantity(arguments.threshold, {"%": 0.01}, "threshold")
    if threshold > 1:
        raise ConfigurationError(
            f"--threshold: nothing loses {arguments.threshold} of its packets", remedy="--threshold 10%"
        )
    seed = scenario.seeds[0] if arguments.seed is None else arguments.seed
    build(scenario)  # what cannot be run is told before anything runs
    settings.note_shared_beats(scenario, [arguments.policy], [scenario.policy.window], 1)
    with working() as sink:
        told = partial(teller(sink), "satisfy", arguments.rounds + 1)
        runs = _Runs(scenario, seed, told)
        found = satisfy(
            runs,
            lambda window_s: make_policy(
                arguments.policy, window_s=window_s, longest_s=max(window_s, scenario.policy.longest)
            ),
            threshold=threshold,
            window_s=scenario.policy.window,
            most_rounds=arguments.rounds,
        )
    title = f"{scenario.name}, {scenario.topology}, {arguments.policy}, seed {seed}: the satisfaction loop"
    _sheet(title, found).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        say(_words(found, threshold))
    if not found.satisfied:
        show_note(f"no round was satisfactory: {found.reason}")
    return 0 if found.satisfied else MISSED


class _Runs:
    """Runs a scenario by a policy, always the same, and tells how many runs there were."""

    def __init__(self, scenario: CosimScenario, seed: int, told: partial[None]) -> None:
        self._scenario = scenario
        self._seed = seed
        self._told = told
        self._done = 0

    def __call__(self, policy: SyncPolicy) -> Run:
        self._told(self._done)
        self._done += 1
        return build(self._scenario, policy=policy, seed=self._seed, measures_all=True).run()


def _sheet(title: str, found: Satisfaction) -> Sheet:
    rows = [
        (
            index,
            one.window_s,
            one.median_window_s,
            one.loss,
            one.errors.fate_disagreement,
            one.errors.delivery_error_s.mean,
            one.errors.position_error_m.mean,
            one.exchanges,
        )
        for index, one in enumerate(found.rounds, start=1)
    ]
    return Sheet(_COLUMNS, rows, [SheetPart(title, [column.name for column in _COLUMNS])])


def _words(found: Satisfaction, threshold: float) -> str:
    reference = f"the exact reference loses {number(100 * found.reference_loss)} % in {found.reference_exchanges:,}"
    lines = [f"{reference} exchanges, whatever the window"]
    if found.rounds:
        last = found.rounds[-1]
        outcome = "accepted" if found.satisfied else "not accepted"
        lines.append(
            f"{outcome} at {number(100 * threshold)} %: {number(100 * last.loss)} % after "
            f"{format_count(len(found.rounds), 'round')} and {found.exchanges:,} exchanges"
        )
    return "\n".join(lines)
