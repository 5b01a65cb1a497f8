"""What the options of a command make of a scenario."""

import argparse
import inspect
from typing import Any

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.policies import POLICIES, make_policy
from sim_backends.cosim.scenario.schema import CosimScenario


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
        if (value := getattr(arguments, option)) is not None:
            found[key] = value
    return found


def seeds(arguments: argparse.Namespace, chosen: CosimScenario) -> tuple[int, ...]:
    """Return the seeds of the runs."""
    if arguments.seeds is not None:
        return tuple(range(1, arguments.seeds + 1))
    return (chosen.seeds[0] if arguments.seed is None else arguments.seed,)


def _change(text: str) -> tuple[str, Any]:
    key, separator, value = text.partition("=")
    if not separator or not all(key.split(".")):
        raise ConfigurationError(
            f"--set: {text!r} does not say which key gets which value",
            remedy="write for example --set policy.window=5ms",
        )
    # A value is YAML, as in the file: a number, a list, or a text.
    return key, schema.parse(f"value: {value}", source="--set").data["value"]


def policy(arguments: argparse.Namespace, chosen: CosimScenario) -> str:
    """Return the name of the sync policy.

    Raises:
        ConfigurationError: There is none of this name, or its parameters are none.
    """
    name = arguments.policy or chosen.policy.name
    make_policy(name, **chosen.policy.parameters)
    return str(name)


def in_words(name: str, chosen: CosimScenario) -> str:
    """Return a sync policy with the parameter that decides its windows: `sliding_window 10 ms`."""
    taken = inspect.signature(POLICIES[name]).parameters
    if "window_s" in taken:
        return f"{name} {chosen.policy.window * 1e3:g} ms"
    return f"{name} {chosen.policy.bound:g} m" if "bound_m" in taken else name
