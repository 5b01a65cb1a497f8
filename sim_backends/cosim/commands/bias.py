"""The command `fieldkit cosim shootout --bias`, which computes the bias of each sync policy.

The bias of a measure, for example of the loss, is the mean over seeds of its difference from the exact reference.
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial

from fieldkit.cli.display import show_note, showing_progress
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.result_texts import BIAS_LABELS
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.scenario.build import Simulation, build
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.shootout import Bias, compute_biases, run_outcomes


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario with each policy and each seed, and print the mean differences from the reference.

    Raises:
        ConfigurationError: There is only one seed.
    """
    scenario = settings.read_scenario(arguments)
    policies = settings.read_policies(arguments)
    seeds = settings.read_seeds(arguments, scenario)
    if len(seeds) < 2:
        raise ConfigurationError("--bias compares several seeds, but there is only one", remedy="add --seeds 20")
    window_s, *unused_windows_s = settings.read_windows_s(arguments, scenario)
    scenario = settings.with_window(scenario, window_s)
    if unused_windows_s:
        show_note(f"--bias uses only the shortest window of --window, {window_s * 1e3:g} ms")
    draw = None if arguments.figure is None else settings.open_figure(arguments.figure, "--figure")
    build(without_federates(scenario))  # raises before any run if the scenario is invalid
    settings.note_commensurate_events(scenario, policies, [scenario.policy.window], len(seeds))
    with showing_progress() as sink:
        runs = len({*policies, EventDriven.name}) * len(seeds)
        all_outcomes = run_outcomes(
            partial(_build, scenario),
            policies,
            seeds,
            workers=settings.read_workers(arguments, scenario.packets * runs),
            progress=partial(progress_reporter(sink), "bias", runs),
        )
    by_policy = {name: measures for name, measures in compute_biases(all_outcomes).items() if name in policies}
    title = f"{scenario.name}, {scenario.topology}, {len(seeds)} seeds"
    _sheet(title, by_policy, arguments.format).show(arguments.format)
    for name, failure in all_outcomes.failures.items():
        show_note(f"{name}: {failure}")
    if draw is not None:
        from sim_backends.cosim.commands import plot  # noqa: PLC0415 (importing matplotlib takes half a second)

        draw(plot.bias_of_policies(by_policy))
    return 0


def _build(scenario: CosimScenario, policy: str, seed: int) -> Simulation:
    return build(scenario, policy=policy, seed=seed)


def _sheet(title: str, by_policy: Mapping[str, Mapping[str, Bias]], form: str) -> Sheet:
    rows: list[Sequence[Value]] = []
    for name, (label, factor) in BIAS_LABELS.items():
        scale, measure_label = (factor, label) if form in {"table", "markdown"} else (1.0, name)
        for policy, measures in by_policy.items():
            bias = measures[name]
            values = bias.mean.value, bias.bias.value, bias.bias.low, bias.bias.high
            rows.append((policy, measure_label, *(value * scale for value in values), bias.seeds_needed))
    columns = (
        SheetColumn("policy", "policy", ""),
        SheetColumn("measure", "measure", ""),
        SheetColumn("mean", "mean", "mean over seeds"),
        SheetColumn("bias", "bias", f"mean of the differences from {EventDriven.name} with the same seed"),
        SheetColumn("bias_low", "low", "lower end of its 95 % interval"),
        SheetColumn("bias_high", "high", "upper end of this interval"),
        SheetColumn("seeds_needed", "seeds", "number of seeds needed to detect this bias in four of five studies"),
    )
    return Sheet(columns, rows, [SheetPart(f"{title}: bias over seeds", [column.name for column in columns])])
