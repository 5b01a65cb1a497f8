"""Errors that name the federate or program that failed or did not answer, and the request that it got."""

from fieldkit.core.errors import FieldkitError


class FederateError(FieldkitError):
    """A federate or program failed or gave an impossible answer; the message names it, the time and the request."""


class UnansweredError(FederateError):
    """A federate or program did not answer within its deadline."""

    exit_code = 3


class AnswerTimeoutError(TimeoutError):
    """Raised by a federate or program that has waited for longer than its deadline, in wall time.

    Attributes:
        limit_s: The deadline, in seconds of wall time.
    """

    def __init__(self, limit_s: float) -> None:
        super().__init__(f"no answer for {limit_s:g} s")
        self.limit_s = limit_s


def federate_error(error: BaseException, federate: str, request: str) -> FederateError:
    """Return the error that names the federate or program that raised `error`.

    Args:
        error: The error.
        federate: Name of the federate or program, for the message.
        request: What it was asked to do, with simulated times: `advance from 0 s to 1 s`.
    """
    if isinstance(error, FederateError):
        return error
    if isinstance(error, AnswerTimeoutError):
        return UnansweredError(
            f"{federate} has not answered for {error.limit_s:g} s: asked to {request}",
            remedy="check what it waits for, or give it a longer deadline",
        )
    return FederateError(
        f"{federate} failed when it was asked to {request}: {type(error).__name__}: {error}",
        remedy=error.remedy if isinstance(error, FieldkitError) else "",
    )


def seconds_text(time_ns: int) -> str:
    """Return a simulated time in seconds as text, with all its digits."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}".rstrip("0").rstrip(".") + " s"
