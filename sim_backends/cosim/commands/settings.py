"""What the options of a command make of a scenario."""

import argparse
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from fieldkit.cli.display import show_note
from fieldkit.config import schema
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, typed
from fieldkit.core.units import format_count, parse_duration_s
from fieldkit.report.theme import Format, format_of
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.phases import other_window_s, shared_beats
from sim_backends.cosim.scenario.policies import POLICIES, make_policy
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.stalls import DEADLINE_S

ENOUGH_SEEDS: Final = 20
"""With as many the mean of one drawn phase each is off by 7 % of a window (standard error)."""


def scenario(arguments: argparse.Namespace) -> CosimScenario:
    """Return the scenario that the arguments name, with the changes that they make.

    Raises:
        ConfigurationError: There is none, or it cannot be changed so; says what, and where.
    """
    return load_scenario(arguments.scenario, changes(arguments))


def changes(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values that options put in the place of a scenario's, by the keys that lead to them."""
    found = dict(map(_change, arguments.set))
    for option, key in (("duration", "duration"), ("window", "policy.window")):
        if (value := getattr(arguments, option, None)) is not None:
            found[key] = value
    return found


def seeds(arguments: argparse.Namespace, chosen: CosimScenario) -> tuple[int, ...]:
    """Return the seeds of the runs: by the options, else the scenario's."""
    if arguments.seeds is not None:
        return tuple(range(1, arguments.seeds + 1))
    return chosen.seeds if arguments.seed is None else (arguments.seed,)


def policies(arguments: argparse.Namespace) -> list[str]:
    """Return the names of the sync policies, each once, in the order in which all are listed.

    Raises:
        ConfigurationError: There is none of one of these names.
    """
    for name in arguments.policy:
        make_policy(name)
    return [name for name in POLICIES if not arguments.policy or name in arguments.policy]


def windows_s(arguments: argparse.Namespace, chosen: CosimScenario) -> list[float]:
    """Return the windows of a comparison in seconds, the shortest first.

    Raises:
        ConfigurationError: One of them is no duration above 0.
    """
    if not arguments.windows:
        return [chosen.policy.window]
    found = sorted({parse_duration_s(text) for text in arguments.windows.split(",")})
    if found[0] <= 0:
        raise ConfigurationError(
            f"--window: {arguments.windows!r} has a window that is not above 0", remedy="--window 1ms,10ms,100ms"
        )
    return found


def with_window(chosen: CosimScenario, window_s: float) -> CosimScenario:
    """Return a scenario with another window."""
    return chosen.model_copy(update={"policy": chosen.policy.model_copy(update={"window": window_s})})


def has_window(name: str) -> bool:
    """Return whether a sync policy takes a window."""
    return "window_s" in inspect.signature(POLICIES[name]).parameters


def figure(path: Path, option: str) -> Callable[[Callable[[Format], bytes]], None]:
    """Return what writes a figure.

    Args:
        path: Where to.
        option: Which says so.

    Raises:
        ConfigurationError: No figure can be there; that it cannot be written may also turn out only then.
    """
    form = format_of(path, option)
    if not path.parent.is_dir():
        raise ConfigurationError(
            "there is no such folder", where=str(path.parent), remedy=typed("mkdir", "-p", path.parent)
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


def deadline_s(text: str | None) -> float:
    """Return the longest wait of a federate for an answer, in seconds of wall time.

    Raises:
        ConfigurationError: It is no duration above 0.
    """
    if text is None:
        return DEADLINE_S
    found = parse_duration_s(text)
    if found <= 0:
        raise ConfigurationError(f"--deadline: nobody answers within {text}", remedy="--deadline 30s")
    return found


def policy(arguments: argparse.Namespace, chosen: CosimScenario) -> str:
    """Return the name of the sync policy.

    Raises:
        ConfigurationError: There is none of this name, or its parameters are none.
    """
    name = chosen.policy.name if arguments.policy is None else arguments.policy
    make_policy(name, **chosen.policy.parameters)
    return str(name)


def note_shared_beats(chosen: CosimScenario, policies: Sequence[str], windows_s: Sequence[float], seeds: int) -> None:
    """Tell on standard error of windows of which packets meet few phases, and what to take instead.

    Args:
        chosen: The scenario.
        policies: Names of the sync policies that run it.
        windows_s: Windows of those that have one.
        seeds: How many there are, each of which draws other phases.
    """
    if seeds >= ENOUGH_SEEDS:
        return
    taken = [one for one in windows_s if any(map(has_window, policies))]
    for window_s in taken:
        shared = shared_beats(chosen, [window_s])
        if not shared:
            continue
        beats = ", ".join(
            f"{one.beat.name} (every {one.beat.period_s * 1e3:.6g} ms: {format_count(one.phases, 'phase')})"
            for one in shared
        )
        other_s = other_window_s(chosen, window_s)
        instead = f"--seeds {ENOUGH_SEEDS}" if other_s is None else f"--window {other_s * 1e3:.6g}ms"
        show_note(
            f"the window of {window_s * 1e3:.6g} ms shares a beat with {beats}; errors and added delays are those of "
            f"these phases, which the seed draws, and not of the method: take {instead}"
            + ("" if other_s is None else f", or --seeds {ENOUGH_SEEDS}")
        )


def in_words(name: str, chosen: CosimScenario) -> str:
    """Return a sync policy with the parameter that decides its windows: `sliding_window 10 ms`."""
    if has_window(name):
        return f"{name} {chosen.policy.window * 1e3:g} ms"
    if "bound_m" not in inspect.signature(POLICIES[name]).parameters:
        return name
    bound_db = chosen.policy.bound_db
    return f"{name} {chosen.policy.bound:g} m" if bound_db is None else f"{name} {bound_db:g} dB"


def _change(text: str) -> tuple[str, Any]:
    key, separator, value = text.partition("=")
    if not separator or not all(key.split(".")):
        raise ConfigurationError(
            f"--set: {text!r} does not say which key gets which value",
            remedy="write for example --set policy.window=5ms",
        )
    # A value is YAML, as in the file: a number, a list, or a text.
    return key, schema.parse(f"value: {value}", source="--set").data["value"]
