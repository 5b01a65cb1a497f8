"""Reads the options of a command, applies them to a scenario, and reports the progress of runs."""

import argparse
import inspect
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from fieldkit.cli.display import show_note
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.events import Progress, Sink
from fieldkit.core.executors import Workers
from fieldkit.core.units import format_count, parse_duration_s, plain_number
from fieldkit.report.theme import Format, format_of
from sim_backends.cosim.policies import registry
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.real_time import LATE_BOUND_S, Pace
from sim_backends.cosim.scenario.loading import load_scenario, parse_value
from sim_backends.cosim.scenario.phases import commensurate_events, incommensurate_window_s
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.seeds import workers_for
from sim_backends.cosim.wall_time import DEADLINE_S


def progress_reporter(sink: Sink, unit: str = "runs") -> Callable[[str, float, float], None]:
    """Return a function that reports progress to a sink; its arguments are the activity, the total and the done part.

    The remaining time is estimated from the time since the first call for the same activity.

    Args:
        sink: Receives the events.
        unit: Unit of total and part.
    """
    start_s: dict[str, float] = {}

    def report(activity: str, total: float, done: float) -> None:
        now_s = time.monotonic()
        elapsed_s = now_s - start_s.setdefault(activity, now_s)
        remaining_s = elapsed_s * (total / done - 1) if done and elapsed_s else None
        sink(Progress(activity, done, total, unit, remaining_s))

    return report


ENOUGH_SEEDS: Final = 20
"""With at least this number of seeds, commensurate periods are not reported.

A period is commensurate with a window if a few periods are a whole number of windows. The event then occurs only at a
few times within a window (phases), which the seed determines. The mean over the phases of 20 seeds has a standard
error of 6.5 % of a window.
"""


def read_scenario(arguments: argparse.Namespace) -> CosimScenario:
    """Return the scenario that the arguments name, with the changes of other arguments.

    Raises:
        ConfigurationError: The scenario does not exist, or a change is invalid; the message states the key and its
            line in the file.
    """
    return load_scenario(arguments.scenario, read_changes(arguments))


_KEYS: Final = (
    ("duration", "duration"),
    ("window", "policy.window"),
    ("physics", "physics.federate"),
    ("network", "network.federate"),
    ("emane_events", "emane.channel"),
    ("emane_device", "emane.device"),
)
"""Options that change values of a scenario."""


def read_changes(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values that options change, by their keys in the scenario's file."""
    values = dict(map(_change, arguments.set))
    for option, key in _KEYS:
        if (value := getattr(arguments, option, None)) is not None:
            values[key] = value
    return values


def read_seeds(arguments: argparse.Namespace, scenario: CosimScenario) -> tuple[int, ...]:
    """Return the seeds from the options; without such options, the seeds of the scenario."""
    if arguments.seeds is not None:
        return tuple(range(1, arguments.seeds + 1))
    return scenario.seeds if arguments.seed is None else (arguments.seed,)


def read_workers(arguments: argparse.Namespace, packets: float = math.inf) -> Workers:
    """Return the workers from the options; without such options, only this process if there are few packets.

    Args:
        arguments: The options.
        packets: Approximate number of packets in all runs.
    """
    return workers_for(packets, Workers(arguments.jobs, arguments.cluster))


def read_policies(arguments: argparse.Namespace) -> list[str]:
    """Return the names of the sync policies without repetitions, in the order of `registry.policies`.

    Raises:
        ConfigurationError: There is no policy with one of the names.
    """
    for name in arguments.policy:
        make_policy(name)
    return [name for name in registry.policies() if not arguments.policy or name in arguments.policy]


def read_windows_s(arguments: argparse.Namespace, scenario: CosimScenario) -> list[float]:
    """Return the different windows of a comparison in seconds, in ascending order.

    Raises:
        ConfigurationError: A window is not a duration above 0.
    """
    if not arguments.windows:
        return [scenario.policy.window]
    windows = sorted({parse_duration_s(text, "--window") for text in arguments.windows.split(",")})
    if windows[0] <= 0:
        raise ConfigurationError(
            f"--window: {arguments.windows!r} contains a window that is not above 0",
            remedy="write for example --window 1ms,10ms,100ms",
        )
    return windows


def with_window(scenario: CosimScenario, window_s: float) -> CosimScenario:
    """Return a scenario with another window."""
    return scenario.model_copy(update={"policy": scenario.policy.model_copy(update={"window": window_s})})


def has_window(name: str) -> bool:
    """Return True if a sync policy has the parameter `window_s`."""
    return "window_s" in inspect.signature(registry.policies()[name]).parameters


def open_figure(path: Path, option: str) -> Callable[[Callable[[Format], bytes]], None]:
    """Return a function that writes a figure; its argument is the function that draws it.

    Args:
        path: The file.
        option: Name of the option with the path, for messages.

    Raises:
        ConfigurationError: The suffix or the folder is invalid. The returned function raises it if the file cannot be
            written.
    """
    form = format_of(path, option)
    if not path.parent.is_dir():
        raise ConfigurationError(
            "there is no such folder", where=str(path.parent), remedy=shell_command("mkdir", "-p", path.parent)
        )

    def write(draw: Callable[[Format], bytes]) -> None:
        try:
            files.write(path, draw(form))
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", where=str(path), remedy=f"choose another {option}"
            ) from error
        show_note(f"drawn: {path}")

    return write


def parse_deadline_s(text: str | None) -> float:
    """Return the longest wait for the answer of a federate, in seconds of wall time.

    Raises:
        ConfigurationError: `text` is not a duration above 0.
    """
    if text is None:
        return DEADLINE_S
    seconds = parse_duration_s(text, "--deadline")
    if seconds <= 0:
        raise ConfigurationError(f"--deadline: {text} is not above 0", remedy="write for example --deadline 30s")
    return seconds


def read_pace(arguments: argparse.Namespace) -> Pace | None:
    """Return the pace of runs in real time, or None if they run as fast as possible.

    Raises:
        ConfigurationError: A value is invalid, or there is a bound but no factor.
    """
    text, bound = arguments.realtime, arguments.late_bound
    if text is None:
        if bound is not None:
            raise ConfigurationError("--late-bound needs --realtime", remedy="add --realtime 1")
        return None
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not 0 < factor < math.inf:
        raise ConfigurationError(
            f"--realtime: {text!r} is not a number above 0", remedy="write for example --realtime 1"
        )
    bound_s = LATE_BOUND_S if bound is None else parse_duration_s(bound, "--late-bound")
    if bound_s <= 0:
        raise ConfigurationError(
            f"--late-bound: {bound} is not above 0", remedy="write for example --late-bound 100ms"
        )
    return Pace(factor, bound_s)


def read_policy(arguments: argparse.Namespace, scenario: CosimScenario) -> str:
    """Return the name of the sync policy.

    Raises:
        ConfigurationError: There is no policy with this name, or a parameter is invalid.
    """
    name = scenario.policy.name if arguments.policy is None else arguments.policy
    make_policy(name, **scenario.policy.parameters)
    return str(name)


def note_commensurate_events(
    scenario: CosimScenario, policies: Sequence[str], windows_s: Sequence[float], seeds: int
) -> None:
    """Print a note on each window that is commensurate with a period of the scenario; suggest a better window.

    Periodic events then occur only at few times within a window (phases), which are not typical of the policy. There
    are no notes if there are at least `ENOUGH_SEEDS` seeds, or if no policy has a window.

    Args:
        scenario: The scenario.
        policies: Names of the sync policies that run it.
        windows_s: The windows with which the policies that have a window run.
        seeds: Number of seeds; each seed draws different phases.
    """
    if seeds >= ENOUGH_SEEDS:
        return
    used_s = [window_s for window_s in windows_s if any(map(has_window, policies))]
    for window_s in used_s:
        commensurate = commensurate_events(scenario, [window_s])
        if not commensurate:
            continue
        periods = ", ".join(
            f"{item.event.name} (every {item.event.period_s * 1e3:.6g} ms: {format_count(item.phases, 'phase')})"
            for item in commensurate
        )
        other_s = incommensurate_window_s(scenario, window_s)
        instead = f"--seeds {ENOUGH_SEEDS}" if other_s is None else f"--window {plain_number(other_s * 1e3, 6)}ms"
        show_note(
            f"the window of {window_s * 1e3:.6g} ms is commensurate with the period of {periods}: these events occur "
            "at few times within a window (phases), which the seed draws. Errors and added delays depend on these "
            f"phases, so they are not typical of the policy: use {instead}"
            + ("" if other_s is None else f", or --seeds {ENOUGH_SEEDS}")
        )


def policy_text(name: str, scenario: CosimScenario) -> str:
    """Return the name of a sync policy and the parameter that determines its windows: `sliding_window 10 ms`.

    A policy without such a parameter is described by its name only.
    """
    if has_window(name):
        return f"{name} {scenario.policy.window * 1e3:g} ms"
    if "bound_m" not in inspect.signature(registry.policies()[name]).parameters:
        return name
    bound_db = scenario.policy.bound_db
    return f"{name} {scenario.policy.bound:g} m" if bound_db is None else f"{name} {bound_db:g} dB"


def _change(text: str) -> tuple[str, Any]:
    """Return the key and the value of an option `--set KEY=VALUE`."""
    key, separator, value = text.partition("=")
    if not separator or not all(key.split(".")):
        raise ConfigurationError(
            f"--set: {text!r} is not KEY=VALUE",
            remedy="write for example --set policy.window=5ms",
        )
    return key, parse_value(value, "--set")
