"""`fieldkit cosim shootout SCENARIO --bias`: errors in distribution, over seeds."""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Final

from fieldkit.cli.display import show_note, working
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.scenario.build import Simulation, build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.bias import Bias, biases
from sim_backends.cosim.studies.outcomes import outcomes

MEASURES: Final[Mapping[str, tuple[str, float]]] = MappingProxyType(
    {"loss": ("packets lost (%)", 100.0), "delay_s": ("delay (ms)", 1e3), "apart_m": ("agents apart (m)", 1.0)}
)
"""Of each measure what people call it, and the factor from SI units."""


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario by each policy with each seed, and print what differs in the mean.

    Raises:
        ConfigurationError: There is one seed alone.
    """
    scenario = settings.scenario(arguments)
    policies = settings.policies(arguments)
    seeds = settings.seeds(arguments, scenario)
    if len(seeds) < 2:
        raise ConfigurationError("--bias: one seed has no distribution", remedy="add --seeds 20")
    if arguments.windows:
        scenario = settings.with_window(scenario, settings.windows_s(arguments, scenario)[0])
    draw = None if arguments.figure is None else settings.figure(arguments.figure, "--figure")
    build(scenario)  # what cannot be run is told before anything runs
    settings.note_shared_beats(scenario, policies, [scenario.policy.window], len(seeds))
    with working() as sink:
        runs = len({*policies, EventDriven.name}) * len(seeds)
        found = outcomes(partial(_make, scenario), policies, seeds, progress=partial(teller(sink), "bias", runs))
    told = {name: one for name, one in biases(found).items() if name in policies}
    _sheet(f"{scenario.name}, {scenario.topology}, {len(seeds)} seeds", told, arguments.format).show(arguments.format)
    for name, failure in found.failures.items():
        show_note(f"{name}: {failure}")
    if draw is not None:
        from sim_backends.cosim.commands import figures  # noqa: PLC0415 (matplotlib takes half a second)

        draw(figures.bias_of_policies(told))
    return 0


def _make(scenario: CosimScenario, policy: str, seed: int) -> Simulation:
    return build(scenario, policy=policy, seed=seed)


def _sheet(title: str, found: Mapping[str, Mapping[str, Bias]], form: str) -> Sheet:
    rows: list[Sequence[Value]] = []
    for name, (words, factor) in MEASURES.items():
        scale, said = (factor, words) if form in {"table", "markdown"} else (1.0, name)
        for policy, measures in found.items():
            one = measures[name]
            values = one.mean.value, one.bias.value, one.bias.low, one.bias.high
            rows.append((policy, said, *(value * scale for value in values), one.seeds_needed))
    columns = (
        SheetColumn("policy", "policy", ""),
        SheetColumn("measure", "of", ""),
        SheetColumn("mean", "mean", "over seeds"),
        SheetColumn("bias", "bias", f"mean of the differences from {EventDriven.name} with the same seed"),
        SheetColumn("bias_low", "low", "lower end of its 95 % interval"),
        SheetColumn("bias_high", "high", "upper end"),
        SheetColumn("seeds_needed", "seeds", "that it takes to see this bias in four of five studies"),
    )
    return Sheet(columns, rows, [SheetPart(f"{title}: in distribution", [column.name for column in columns])])
