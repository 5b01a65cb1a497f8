"""The ends of windows that a policy returns, checked, because the policy may come from another package."""

from operator import index
from typing import Final

from fieldkit.core.errors import FieldkitError, describe_exception
from sim_backends.cosim.federates import FederateError, seconds_text
from sim_backends.cosim.policies.sync_policy import PolicyError, Situation, SyncPolicy

_MAX_EMPTY_WINDOWS: Final = 1000
"""Largest number of successive windows of length 0; after more, the run fails."""


class WindowEnds:
    """Gets the ends of windows from policies, and limits the number of successive windows of length 0."""

    def __init__(self) -> None:
        self._empty_at_ns = self._empty_count = 0

    def next_ns(self, policy: SyncPolicy, situation: Situation, begin_ns: int, to_ns: int) -> int:
        """Return the end of the window that begins at `begin_ns`, as determined by the policy, but at most `to_ns`.

        Raises:
            PolicyError: The policy cannot determine a window, or time does not advance.
            FederateError: The policy failed, or did not return a whole number.
        """
        try:
            end_ns = policy.next_window(situation)
        except PolicyError:
            raise
        except Exception as error:
            raise FederateError(
                f"policy {policy.name} failed to return the end of {_window_text(begin_ns)}: "
                f"{describe_exception(error)}",
                remedy=error.remedy if isinstance(error, FieldkitError) else "",
            ) from error
        if end_ns is None:
            return to_ns
        try:
            end_ns = index(end_ns)
        except TypeError as error:
            raise FederateError(
                f"policy {policy.name} returned {end_ns!r} as the end of {_window_text(begin_ns)}",
                remedy="return a whole number of nanoseconds, or None",
            ) from error
        if end_ns > to_ns:
            return to_ns
        if end_ns <= begin_ns:
            self._add_empty(policy.name, begin_ns, end_ns)
        return end_ns

    def _add_empty(self, policy: str, begin_ns: int, end_ns: int) -> None:
        """Count a window in which time does not advance.

        Raises:
            PolicyError: There are too many such windows in succession, or time would run backwards.
        """
        if begin_ns != self._empty_at_ns:
            self._empty_at_ns, self._empty_count = begin_ns, 0
        self._empty_count += 1
        if end_ns < begin_ns or self._empty_count > _MAX_EMPTY_WINDOWS:
            raise PolicyError(
                f"time does not advance beyond {begin_ns} ns",
                where=policy,
                remedy="use another policy, or correct it",
            )


def _window_text(begin_ns: int) -> str:
    return f"the window that begins at {seconds_text(begin_ns)}"
