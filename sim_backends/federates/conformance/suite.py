"""The conformance suite of external federates: all checks of a role, and their results."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from fieldkit.core.errors import FieldkitError
from sim_backends.federates.conformance import common_checks, motion_checks, network_checks, physics_checks
from sim_backends.federates.conformance.probe import CheckError, NotDeclaredError, Target

Check = Callable[[Target], None]


@dataclass(frozen=True)
class ConformanceResult:
    """The result of a check.

    Attributes:
        name: Name of the check.
        meaning: The requirement that it checks.
        failure: The violation; empty if it passed or does not apply.
        skipped: The reason why it does not apply; empty if it applies.
        request: The last request, if it failed.
        answer: The answer to the last request, if it failed.
    """

    name: str
    meaning: str
    failure: str = ""
    skipped: str = ""
    request: str = ""
    answer: str = ""


def checks(*, is_physics: bool) -> dict[str, Check]:
    """Return all checks of a role by name."""
    modules = (common_checks, *((physics_checks, motion_checks) if is_physics else (network_checks,)))
    return {
        name.removeprefix("check_"): function
        for module in modules
        for name, function in vars(module).items()
        if name.startswith("check_")
    }


def run_checks(target: Target) -> Iterator[ConformanceResult]:
    """Run all checks of the target's role, each with new federates, and yield their results."""
    for name, check in checks(is_physics=target.is_physics).items():
        yield run_check(target, name, check)


def run_check(target: Target, name: str, check: Check) -> ConformanceResult:
    """Run one check, and return its result."""
    meaning = (check.__doc__ or "").partition("\n")[0]
    failure = skipped = ""
    try:
        check(target)
    except NotDeclaredError as error:
        skipped = str(error)
    except CheckError as error:
        failure = str(error)
    except FieldkitError as error:
        failure = error.what
    finally:
        target.close()
    if not failure:
        return ConformanceResult(name, meaning, skipped=skipped)
    return ConformanceResult(name, meaning, failure, "", target.exchange["request"], target.exchange["answer"])
