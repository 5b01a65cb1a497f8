"""`fieldkit cosim run SCENARIO`: one sync policy, one seed or many."""

import argparse
import hashlib
from collections.abc import Sequence
from typing import Final

from fieldkit.cli.display import show_note, working
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.execution import Outcome, outcomes
from sim_backends.cosim.commands.folder import RunFolder
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, Value, number
from sim_backends.cosim.scenario.schema import CosimScenario

INTERRUPTED: Final = 130

_COLUMNS: Final = (
    SheetColumn("seed", "seed", "seed of the run"),
    SheetColumn("flow", "flow", "stream of packets, to whom"),
    SheetColumn("protocol", "by", "its transport"),
    SheetColumn("sent", "sent", "packets whose fate is known"),
    SheetColumn("loss", "lost (%)", "share of them that never arrived", 100),
    SheetColumn("delay_mean_s", "delay (ms)", "mean time that the network had a packet", 1e3),
    SheetColumn("delay_p95_s", "p95 (ms)", "its 95th percentile", 1e3),
    SheetColumn("delay_max_s", "max (ms)", "its maximum", 1e3),
    SheetColumn("delay_added_s", "added (ms)", "mean of what the sync policy added", 1e3),
    SheetColumn("distance_mean_m", "apart (m)", "mean distance of sender and receiver"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario with each seed; print what became of its flows, and keep it where that was asked for."""
    scenario = settings.scenario(arguments)
    policy = settings.policy(arguments, scenario)
    seeds = settings.seeds(arguments, scenario)
    folder = (
        None if arguments.out is None else RunFolder(arguments.out, scenario, settings.in_words(policy, scenario))
    )
    done: list[Outcome] = []
    code = 0
    with working() as sink:
        try:
            for outcome in outcomes(scenario, policy, seeds, sink):
                done.append(outcome)
                if folder is not None:
                    folder.keep(done)
        except KeyboardInterrupt:
            code = INTERRUPTED
    if done:
        _sheet(scenario, settings.in_words(policy, scenario), done).show(arguments.format)
    if done and arguments.format == "table":
        print(_cost(done))
    for outcome in done:
        if outcome.stopped:
            show_note(f"seed {outcome.seed}: {outcome.stopped}; its numbers are those until then")
    if folder is not None:
        show_note(f"kept in {folder.path}; to put it together: fieldkit aggregate {folder.path}")
    return code


def _sheet(scenario: CosimScenario, policy: str, done: Sequence[Outcome]) -> Sheet:
    rows: list[Sequence[Value]] = [
        (
            outcome.seed,
            flow.name,
            flow.protocol,
            flow.sent,
            flow.loss,
            flow.delay_s.mean,
            flow.delay_s.p95,
            flow.delay_s.most,
            flow.added_s,
            flow.distances_m[2],
        )
        for outcome in done
        for flow in outcome.flows
    ]
    title = f"{scenario.name}, {policy}, {scenario.topology}"
    return Sheet(title, _COLUMNS, rows, unshown=() if len(done) > 1 else ("seed",))


def _cost(done: Sequence[Outcome]) -> str:
    """Return in words what the runs cost, and the hash of all that happened in them."""
    simulated_s = sum(outcome.simulated_s for outcome in done)
    wall_s = sum(sum(outcome.wall_s.values()) for outcome in done)
    if not simulated_s or not wall_s:
        return "no time was simulated"
    parts = {part: sum(outcome.wall_s[part] for outcome in done) for part in done[0].wall_s}
    split = ", ".join(f"{part} {100 * spent_s / wall_s:.0f} %" for part, spent_s in parts.items())
    exchanges = sum(outcome.windows for outcome in done) / simulated_s
    return (
        f"{number(simulated_s)} s simulated, {number(simulated_s / wall_s)} times as fast as real time; "
        f"{number(exchanges)} exchanges per simulated second\n"
        f"wall time: {split}\n"
        f"event hash: {_together([outcome.digest for outcome in done])}"
    )


def _together(digests: Sequence[str]) -> str:
    """Return one hash for those of several runs, in their order."""
    if len(digests) == 1:
        return digests[0]
    return hashlib.blake2b("".join(digests).encode(), digest_size=16).hexdigest()
