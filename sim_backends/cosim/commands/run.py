"""The command `fieldkit cosim run`, which runs a scenario with one sync policy and one or several seeds."""

import argparse
import hashlib
from collections.abc import Sequence
from typing import Final

from fieldkit.cli.display import show_note, showing_progress
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.executors import Workers
from fieldkit.core.text import print_text
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.execution import simulate_all
from sim_backends.cosim.commands.results import FORMATION, SeedResult, formation_values
from sim_backends.cosim.commands.run_folder import RunFolder
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value, number_text, show_all
from sim_backends.cosim.real_time import RealTimeError
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import has_followers

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as in shells: 128 plus the number of SIGINT."""

_COLUMNS: Final = (
    SheetColumn("seed", "seed", "seed of all random draws"),
    SheetColumn("flow", "flow", "stream of packets and its receiver"),
    SheetColumn("protocol", "transport", "transport of the packets"),
    SheetColumn("sent", "sent", "packets whose fate is decided"),
    SheetColumn(
        "under_way",
        "under way",
        "packets whose fate was not decided when the run ended; the other columns, except the distance, omit them",
    ),
    SheetColumn("loss", "lost (%)", "share of the sent packets that never arrived", 100),
    SheetColumn("delay_mean_s", "delay (ms)", "mean time of a packet in the network", 1e3),
    SheetColumn("delay_p95_s", "p95", "its 95th percentile", 1e3),
    SheetColumn("delay_max_s", "max", "its maximum", 1e3),
    SheetColumn("delay_added_s", "added", "mean delay that the sync policy added, in ms", 1e3),
    SheetColumn("distance_mean_m", "distance (m)", "mean distance between sender and receiver"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario with each seed; print the results of its flows, and write them to a folder on request.

    Raises:
        ConfigurationError: An option or the scenario is invalid, or several runs would publish events of EMANE.
        FieldkitError: A run failed. Its results until the failure are printed and written. A run that was slower than
            real time has no printed results except its lateness.
    """
    scenario = settings.read_scenario(arguments)
    policy = settings.read_policy(arguments, scenario)
    seeds = settings.read_seeds(arguments, scenario)
    if scenario.emane is not None and len(seeds) > 1:
        raise ConfigurationError("only one run can publish events of EMANE", remedy="add --seed 1")
    pace = settings.read_pace(arguments)
    text = settings.policy_text(policy, scenario)
    # If the scenario is invalid, this raises before the folder is created.
    build(without_federates(scenario), policy=policy)
    folder = None if arguments.out is None else RunFolder(arguments.out, scenario, text, seeds)
    settings.note_commensurate_events(scenario, [policy], [scenario.policy.window], len(seeds))
    with showing_progress() as sink:
        results, interrupted = simulate_all(
            scenario,
            policy,
            seeds,
            folder,
            sink=sink,
            deadline_s=settings.parse_deadline_s(arguments.deadline),
            pace=pace,
            workers=Workers(arguments.jobs),
        )
    if results:
        show_results(arguments.format, f"{scenario.name}, {text}, {scenario.topology}", scenario, results)
    if len(results) < len(seeds):
        finished = sum(not result.is_interrupted for result in results)
        show_note(f"interrupted: the runs of {finished} of {len(seeds)} seeds had finished")
    if folder is not None:
        show_note(f"written to {folder.path}; next: fieldkit aggregate {folder.path}")
    if error := next((result.error for result in results if result.error is not None), None):
        raise error
    return INTERRUPTED if interrupted else 0


def show_results(form: str, title: str, scenario: CosimScenario, results: Sequence[SeedResult]) -> None:
    """Print the results of runs.

    Args:
        form: The output format. CSV contains only the flows, or only the lateness if no run has other results.
        title: Title of the runs.
        scenario: The scenario.
        results: The results.
    """
    # A run that was slower than --realtime has no results except its lateness.
    timely_results = [result for result in results if not isinstance(result.error, RealTimeError)]
    sheets = {"flows": _flow_sheet(title, timely_results)} if timely_results else {}
    if any(result.recoveries for result in timely_results):
        sheets["recoveries"] = _recovery_sheet(scenario, timely_results)
    if timely_results and has_followers(scenario):
        sheets["followers"] = _formation_sheet(timely_results)
    if any(result.lateness is not None for result in results):
        sheets["lateness"] = _lateness_sheet(results)
    show_all(sheets, form)
    if form == "table" and timely_results:
        print_text(_cost_text(timely_results))
    for result in results:
        if isinstance(result.error, RealTimeError):
            show_note(f"seed {result.seed}: the run was slower than --realtime, so it has no results")
        elif result.stop_reason:
            # The command reports the full error when it ends.
            reason = result.stop_reason if result.error is None else f"stopped at {result.simulated_s:g} s"
            show_note(f"seed {result.seed}: {reason}; the numbers cover only the time until then")


def _flow_sheet(title: str, results: Sequence[SeedResult]) -> Sheet:
    rows: list[Sequence[Value]] = [
        (
            result.seed,
            flow.name,
            flow.protocol,
            flow.sent_packets,
            flow.packets_under_way,
            flow.loss,
            flow.delay_s.mean,
            flow.delay_s.p95,
            flow.delay_s.maximum,
            flow.added_s,
            flow.distances_m[2],
        )
        for result in results
        for flow in result.flows
    ]
    hidden_columns = {"seed"} if len(results) == 1 else set()
    if not any(flow.packets_under_way for result in results for flow in result.flows):
        hidden_columns.add("under_way")
    return Sheet(_COLUMNS, rows, [SheetPart(title, {column.name for column in _COLUMNS} - hidden_columns)])


def _recovery_sheet(scenario: CosimScenario, results: Sequence[SeedResult]) -> Sheet:
    columns = (
        SheetColumn("seed", "seed", ""),
        SheetColumn("fault", "fault", ""),
        SheetColumn("flow", "flow", ""),
        SheetColumn("end_s", "ended at (s)", "end of the fault"),
        SheetColumn("lost", "lost", "packets that were sent during the fault and lost"),
        SheetColumn(
            "recovered_s",
            "recovered after (ms)",
            "from the end of the fault to the first arrival of a packet that was sent after it",
            1e3,
        ),
    )
    rows: list[Sequence[Value]] = [
        (
            result.seed,
            scenario.faults[recovery.fault].kind,
            recovery.flow,
            recovery.end_ns / 1e9,
            recovery.lost_packets,
            recovery.recovered_s,
        )
        for result in results
        for recovery in result.recoveries
    ]
    hidden_columns = {"seed"} if len(results) == 1 else set()
    return Sheet(columns, rows, [SheetPart("recovery", {column.name for column in columns} - hidden_columns)])


def _lateness_sheet(results: Sequence[SeedResult]) -> Sheet:
    columns = (
        SheetColumn("seed", "seed", ""),
        SheetColumn("late_up_to_s", "late up to (ms)", "upper limit of the lateness of windows; 0: in time", 1e3),
        SheetColumn(
            "windows", "windows", "number of windows with at most this lateness, but more than in the row above"
        ),
        SheetColumn("share", "share (%)", "share of all windows", 100),
    )
    rows = [
        (result.seed, limit_ns / 1e9, count, count / result.lateness.windows.total())
        for result in results
        if result.lateness is not None
        for limit_ns, count in sorted(result.lateness.windows.items())
    ]
    hidden_columns = {"seed"} if len(results) == 1 else set()
    return Sheet(columns, rows, [SheetPart("lateness", {column.name for column in columns} - hidden_columns)])


def _formation_sheet(results: Sequence[SeedResult]) -> Sheet:
    columns = (SheetColumn("seed", "seed", ""), *FORMATION)
    rows = [(result.seed, *formation_values(result.formation)) for result in results]
    hidden_columns = {"seed"} if len(results) == 1 else set()
    return Sheet(columns, rows, [SheetPart("followers", {column.name for column in columns} - hidden_columns)])


def _cost_text(results: Sequence[SeedResult]) -> str:
    """Return the cost of the runs, and the hash over all their events, as text.

    A recording without an end has no hash. It has no window if its run was killed before the first part was written.
    """
    simulated_s = sum(result.simulated_s for result in results)
    wall_s = sum(sum(result.wall_s.values()) for result in results)
    if not simulated_s or not wall_s:
        return "no window was recorded"
    parts = {part: sum(result.wall_s[part] for result in results) for part in results[0].wall_s}
    split = ", ".join(f"{part} {100 * spent_s / wall_s:.0f} %" for part, spent_s in parts.items())
    exchanges = sum(result.windows for result in results) / simulated_s
    speed = f"{number_text(simulated_s / wall_s)} times as fast as real time"
    if any(result.lateness is not None for result in results):
        speed = f"paced by --realtime; without its waits, {speed}"
    digests = [result.digest for result in results]
    hash_line = f"\nevent hash: {_combined_digest(digests)}" if all(digests) else ""
    return (
        f"{number_text(simulated_s)} s simulated, {speed}\n"
        f"{number_text(exchanges)} exchanges per simulated second\n"
        f"wall time: {split}{hash_line}"
    )


def _combined_digest(digests: Sequence[str]) -> str:
    """Return the digest of a single run, or one hash over the digests of several runs."""
    if len(digests) == 1:
        return digests[0]
    return hashlib.blake2b("".join(digests).encode(), digest_size=16).hexdigest()
