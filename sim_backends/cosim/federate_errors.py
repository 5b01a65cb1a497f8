"""Errors that name the party of a co-simulation that failed or did not answer, and the question that it was asked."""

from fieldkit.core.errors import FieldkitError


class FederateError(FieldkitError):
    """A party of a co-simulation failed or gave an impossible answer; names the party, the time and the question."""


class UnansweredError(FederateError):
    """A party did not answer within its deadline."""

    exit_code = 3


class AnswerTimeoutError(TimeoutError):
    """Raised by a federate or program that waited in wall time for longer than its deadline.

    Attributes:
        limit_s: The deadline, in seconds of wall time.
    """

    def __init__(self, limit_s: float) -> None:
        super().__init__(f"no answer for {limit_s:g} s")
        self.limit_s = limit_s


def failed(error: BaseException, who: str, asked: str) -> FederateError:
    """Return the error that names the party which raised `error`.

    Args:
        error: Raised by the party.
        who: The party.
        asked: The question, with its simulated times.
    """
    if isinstance(error, FederateError):
        return error
    if isinstance(error, AnswerTimeoutError):
        return UnansweredError(
            f"{who} has not answered for {error.limit_s:g} s: asked to {asked}",
            remedy="look at what it waits for, or give it a longer deadline",
        )
    return FederateError(
        f"{who} failed when it was asked to {asked}: {type(error).__name__}: {error}",
        remedy=error.remedy if isinstance(error, FieldkitError) else "",
    )


def seconds(time_ns: int) -> str:
    """Return a simulated time in seconds as text, with all its digits."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}".rstrip("0").rstrip(".") + " s"
