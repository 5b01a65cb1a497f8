"""The sync policies by name, and their parameters."""

import inspect
from collections.abc import Callable
from typing import Final

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

POLICIES: Final[dict[str, Callable[..., SyncPolicy]]] = {
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
"""Every policy by its name, exact ones first."""

_WINDOW_S: Final = 0.001
"""The paper's initial window, section V."""


def make_policy(name: str, **parameters: float) -> SyncPolicy:
    """Return a new policy; a policy object serves one run.

    Args:
        name: One of `POLICIES`.
        parameters: `window_s`, `longest_s`, `bound_m`, `bound_db`, `exponent`; parameters that the policy does not
            have are ignored.

    Raises:
        ConfigurationError: There is no such policy, or the value of a parameter is invalid.
    """
    if name not in POLICIES:
        raise ConfigurationError(
            f"there is no sync policy {name!r}",
            remedy=did_you_mean(name, POLICIES, f"policies: {', '.join(POLICIES)}"),
        )
    kind = POLICIES[name]
    accepted = inspect.signature(kind).parameters
    values = {"window_s": _WINDOW_S} | parameters
    return kind(**{key: value for key, value in values.items() if key in accepted})
