"""`fieldkit cosim run SCENARIO`: one sync policy, one seed or many."""

import argparse
import hashlib
from collections.abc import Sequence
from typing import Final

from fieldkit.cli.display import show_note, working
from fieldkit.core.printing import say
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.execution import simulate_all
from sim_backends.cosim.commands.folder import RunFolder
from sim_backends.cosim.commands.followers import FORMATION, formation_values
from sim_backends.cosim.commands.results import SeedResult
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value, number, show_all
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import has_followers

INTERRUPTED: Final = 130

_COLUMNS: Final = (
    SheetColumn("seed", "seed", "of everything random"),
    SheetColumn("flow", "flow", "stream of packets and its receiver"),
    SheetColumn("protocol", "by", "its transport"),
    SheetColumn("sent", "sent", "packets whose fate is known"),
    SheetColumn("under_way", "open", "packets still under way when the run ended, which count nowhere else"),
    SheetColumn("loss", "lost (%)", "of those sent never arrived", 100),
    SheetColumn("delay_mean_s", "delay (ms)", "mean time that the network had a packet", 1e3),
    SheetColumn("delay_p95_s", "p95", "its 95th percentile", 1e3),
    SheetColumn("delay_max_s", "max", "its maximum", 1e3),
    SheetColumn("delay_added_s", "added", "what the sync policy added to it, mean, in ms", 1e3),
    SheetColumn("distance_mean_m", "apart (m)", "sender and receiver, mean"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario with each seed; print what became of its flows, and keep it where that was asked for.

    Raises:
        FieldkitError: A run could not go on; what came of it until then is printed and kept.
    """
    scenario = settings.scenario(arguments)
    policy = settings.policy(arguments, scenario)
    seeds = settings.seeds(arguments, scenario)
    words = settings.in_words(policy, scenario)
    build(scenario, policy=policy)  # what cannot be run leaves no folder behind
    folder = None if arguments.out is None else RunFolder(arguments.out, scenario, words, seeds)
    settings.note_shared_beats(scenario, [policy], [scenario.policy.window], len(seeds))
    with working() as sink:
        results, interrupted = simulate_all(
            scenario, policy, seeds, folder, sink=sink, deadline_s=settings.deadline_s(arguments.deadline)
        )
    if results:
        show_results(arguments.format, f"{scenario.name}, {words}, {scenario.topology}", scenario, results)
    if len(results) < len(seeds):
        show_note(f"interrupted: {len(results)} of {len(seeds)} seeds had ended")
    if folder is not None:
        show_note(f"kept in {folder.path}; next: fieldkit aggregate {folder.path}")
    if error := next((result.error for result in results if result.error is not None), None):
        raise error
    return INTERRUPTED if interrupted else 0


def show_results(form: str, title: str, scenario: CosimScenario, results: Sequence[SeedResult]) -> None:
    """Print what came of runs.

    Args:
        form: How it is printed; CSV has the flows only.
        title: What was run, in words.
        scenario: What was run.
        results: What came of it.
    """
    sheets = {"flows": _sheet(title, results)}
    if any(result.recoveries for result in results):
        sheets["recoveries"] = _recoveries(scenario, results)
    if has_followers(scenario):
        sheets["followers"] = _formations(results)
    show_all(sheets, form)
    if form == "table":
        say(_cost(results))
    for result in results:
        if result.stopped:
            # An error is told in full when the command ends.
            why = result.stopped if result.error is None else f"stopped at {result.simulated_s:g} s"
            show_note(f"seed {result.seed}: {why}; its numbers are those until then")


def _sheet(title: str, done: Sequence[SeedResult]) -> Sheet:
    rows: list[Sequence[Value]] = [
        (
            result.seed,
            flow.name,
            flow.protocol,
            flow.sent,
            flow.under_way,
            flow.loss,
            flow.delay_s.mean,
            flow.delay_s.p95,
            flow.delay_s.most,
            flow.added_s,
            flow.distances_m[2],
        )
        for result in done
        for flow in result.flows
    ]
    unshown = {"seed"} if len(done) == 1 else set()
    if not any(flow.under_way for result in done for flow in result.flows):
        unshown.add("under_way")
    return Sheet(_COLUMNS, rows, [SheetPart(title, {column.name for column in _COLUMNS} - unshown)])


def _recoveries(scenario: CosimScenario, done: Sequence[SeedResult]) -> Sheet:
    columns = (
        SheetColumn("seed", "seed", ""),
        SheetColumn("fault", "fault", ""),
        SheetColumn("flow", "flow", ""),
        SheetColumn("end_s", "ended at (s)", "the fault"),
        SheetColumn("lost", "lost", "packets that were sent during it"),
        SheetColumn("recovered_s", "back after (ms)", "from its end to the first arrival of a later packet", 1e3),
    )
    rows: list[Sequence[Value]] = [
        (result.seed, scenario.faults[one.fault].kind, one.flow, one.end_ns / 1e9, one.lost, one.recovered_s)
        for result in done
        for one in result.recoveries
    ]
    unshown = {"seed"} if len(done) == 1 else set()
    return Sheet(columns, rows, [SheetPart("recovery", {column.name for column in columns} - unshown)])


def _formations(done: Sequence[SeedResult]) -> Sheet:
    columns = (SheetColumn("seed", "seed", ""), *FORMATION)
    rows = [(result.seed, *formation_values(result.formation)) for result in done]
    unshown = {"seed"} if len(done) == 1 else set()
    return Sheet(columns, rows, [SheetPart("followers", {column.name for column in columns} - unshown)])


def _cost(done: Sequence[SeedResult]) -> str:
    """Return in words what the runs cost, and the hash of all that happened in them."""
    simulated_s = sum(result.simulated_s for result in done)
    wall_s = sum(sum(result.wall_s.values()) for result in done)
    if not simulated_s or not wall_s:
        return "no time was simulated"
    parts = {part: sum(result.wall_s[part] for result in done) for part in done[0].wall_s}
    split = ", ".join(f"{part} {100 * spent_s / wall_s:.0f} %" for part, spent_s in parts.items())
    exchanges = sum(result.windows for result in done) / simulated_s
    return (
        f"{number(simulated_s)} s simulated, {number(simulated_s / wall_s)} times as fast as real time\n"
        f"{number(exchanges)} exchanges per simulated second\n"
        f"wall time: {split}\n"
        f"event hash: {_together([result.digest for result in done])}"
    )


def _together(digests: Sequence[str]) -> str:
    """Return one hash for those of several runs, in their order."""
    if len(digests) == 1:
        return digests[0]
    return hashlib.blake2b("".join(digests).encode(), digest_size=16).hexdigest()
