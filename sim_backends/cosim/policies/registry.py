"""Finds and creates sync policies by name; they are built in or come from entry points of packages."""

import inspect
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import EntryPoint
from typing import Final

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.lazy_mapping import LazyMapping
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import SyncPolicy, missing_members
from sim_backends.cosim.policies.window_policies import (
    EventDriven,
    Scheduled,
    SlidingWindow,
    TimeStepped,
    VariableStepped,
    VelocityAware,
    VelocityAwareRaw,
)

PolicyKind = Callable[..., SyncPolicy]
"""A callable that returns a new policy; it accepts some of the parameters of `make_policy`."""

_KINDS: Final[tuple[type[SyncPolicy], ...]] = (
    EventDriven,
    VariableStepped,
    TimeStepped,
    Scheduled,
    SlidingWindow,
    VelocityAwareRaw,
    VelocityAware,
    ErrorBounded,
)
"""The built-in policies, the exact ones first."""
BUILTIN: Final[Mapping[str, PolicyKind]] = {kind.name: kind for kind in _KINDS}
"""Every built-in policy by its name; the exact ones are first."""

_WINDOW_S: Final = 0.001
"""The initial window of the paper (cited in docs/index.md), section V."""


@cache
def policies() -> Mapping[str, PolicyKind]:
    """Return every policy by its name: built-in ones, then policies of other packages, which are loaded on first use.

    A look-up of a policy of another package raises `ConfigurationError` if the policy cannot be loaded, lacks a
    member, or has another name than its entry point.

    Raises:
        ConfigurationError: A policy of a package has the name of a built-in one.
    """
    points = {point.name: point for point in plugins.entry_points(plugins.POLICIES)}
    for name in BUILTIN.keys() & points.keys():
        raise ConfigurationError(
            f"there is already a sync policy {name!r}",
            where=plugins.location(points[name]),
            remedy="uninstall its package",
        )
    builtin = {
        kind.name: EntryPoint(kind.name, f"{kind.__module__}:{kind.__name__}", plugins.POLICIES) for kind in _KINDS
    }
    return LazyMapping({**builtin, **points}, _load)


def _load(point: EntryPoint) -> PolicyKind:
    """Load the sync policy of an entry point, and check its members and its name."""
    kind: PolicyKind = plugins.load(point)
    problem = ""
    if missing_names := missing_members(kind):
        problem = f"the sync policy lacks {', '.join(missing_names)}"
    elif getattr(kind, "name", None) != point.name:
        problem = f"the sync policy's name is {getattr(kind, 'name', None)!r}, but must be {point.name!r}"
    if problem:
        raise ConfigurationError(problem, where=plugins.location(point), remedy=plugins.REMEDY)
    return kind


def unknown_policy_remedy(name: str) -> str:
    """Return the remedy for the name of a policy that does not exist."""
    return did_you_mean(name, policies(), f"policies: {', '.join(policies())}; others need their package installed")


def make_policy(name: str, **parameters: float) -> SyncPolicy:
    """Return a new policy; each policy object is used for one run only.

    Args:
        name: One of `policies()`.
        parameters: `window_s` (default 1 ms), `longest_s`, `bound_m`, `bound_db`, `exponent`; parameters that the
            policy does not have are ignored.

    Raises:
        ConfigurationError: There is no such policy, or the value of a parameter is invalid.
    """
    if name not in policies():
        raise ConfigurationError(f"there is no sync policy {name!r}", remedy=unknown_policy_remedy(name))
    kind = policies()[name]
    accepted = inspect.signature(kind).parameters
    values = {"window_s": _WINDOW_S} | parameters
    try:
        return kind(**{key: value for key, value in values.items() if key in accepted})
    except ConfigurationError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"the sync policy {name!r} cannot be created: {type(error).__name__}: {error}", remedy=plugins.REMEDY
        ) from error
