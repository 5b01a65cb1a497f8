"""The sync policies by name, the built-in ones and those of entry points, and their parameters."""

import inspect
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Final

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import SyncPolicy
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
"""Returns a new policy; its parameters are some of those of `make_policy`."""

BUILTIN: Final[Mapping[str, PolicyKind]] = {
    kind.name: kind
    for kind in (
        EventDriven,
        VariableStepped,
        TimeStepped,
        Scheduled,
        SlidingWindow,
        VelocityAwareRaw,
        VelocityAware,
        ErrorBounded,
    )
}
"""Every built-in policy by its name, exact ones first."""

_MEMBERS: Final = ("exact", "defers_sends", "uses_end_states", "defers_arrivals", "next_window")
"""Members that a policy needs in addition to `name`."""

_WINDOW_S: Final = 0.001
"""The paper's initial window, section V."""


@cache
def policies() -> Mapping[str, PolicyKind]:
    """Return every policy by its name: built-in ones, then those that other packages add.

    Raises:
        ConfigurationError: A policy of a package cannot be loaded, lacks a member, or its name is already used.
    """
    kinds = dict(BUILTIN)
    for point in plugins.entry_points(plugins.POLICIES):
        where = plugins.location(point)
        if point.name in kinds:
            raise ConfigurationError(
                f"there is already a sync policy {point.name!r}", where=where, remedy="uninstall its package"
            )
        kind = plugins.load(point)
        if missing := [member for member in _MEMBERS if not hasattr(kind, member)]:
            raise ConfigurationError(
                f"the sync policy lacks {', '.join(missing)}", where=where, remedy=plugins.REMEDY
            )
        if getattr(kind, "name", None) != point.name:
            raise ConfigurationError(
                f"the sync policy's name is {getattr(kind, 'name', None)!r}, but must be {point.name!r}",
                where=where,
                remedy=plugins.REMEDY,
            )
        kinds[point.name] = kind
    return MappingProxyType(kinds)


def unknown_policy_remedy(name: str) -> str:
    """Return the remedy for the name of a policy that does not exist."""
    return did_you_mean(name, policies(), f"policies: {', '.join(policies())}; others need their package installed")


def make_policy(name: str, **parameters: float) -> SyncPolicy:
    """Return a new policy; each policy object is used for one run only.

    Args:
        name: One of `policies()`.
        parameters: `window_s`, `longest_s`, `bound_m`, `bound_db`, `exponent`; parameters that the policy does not
            have are ignored.

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
            f"the sync policy {name!r} cannot be made: {type(error).__name__}: {error}", remedy=plugins.REMEDY
        ) from error
