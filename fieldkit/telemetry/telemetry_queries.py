"""Telemetry sources of a trial's robots: their commands, and the sources that would disturb the link under test."""

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.core.model import Role
from fieldkit.remote.command import quote
from fieldkit.steps.scene import Refusal
from fieldkit.telemetry.telemetry_section import TelemetrySource, telemetry_of

_REMEDY: Final = "give its address in the control network, or query it on the robot"


def sources(cast: Cast, computer: str) -> Iterator[tuple[Role, str, TelemetrySource]]:
    """Yield role, name and source for each source that a computer queries, `robot` or `laptop`."""
    for role, robot in cast.items():
        telemetry = telemetry_of(robot.profile)
        if telemetry is not None:
            yield from ((role, name, source) for name, source in telemetry.at(computer).items())


def queries_by_role(cast: Cast) -> Mapping[Role, Sequence[Sequence[str]]]:
    """Return the sources that each robot queries: their names and the words of `poll` in telemetry.sh."""
    by_role: dict[Role, list[Sequence[str]]] = {}
    for role, name, source in sources(cast, "robot"):
        words = source.poll_words(cast[role].profile.radio.interface)
        by_role.setdefault(role, []).append((name, *words))
    return by_role


def refusals(cast: Cast, all_robots: Cast) -> Iterator[Refusal]:
    """Yield the sources whose address is a robot's address on the radio: queries would load the link under test.

    Sources with `wired` are permitted.

    An address that is only reached over the radio is detected on the robot before each query.
    """
    by_address = {ipaddress.ip_address(robot.address): robot.name for robot in all_robots.values()}
    for computer in ("robot", "laptop"):
        for role, name, source in sources(cast, computer):
            other = by_address.get(ipaddress.ip_address(source.address)) if source.address else None
            if other is not None and not source.wired:
                what = (
                    f"its telemetry source {name} queries {source.address}, which is {other} on the radio under test"
                )
                yield Refusal(role, what, _REMEDY)


def dry_run_notes(cast: Cast) -> Iterator[str]:
    """Yield a line for each source that the laptop queries."""
    for role, name, source in sources(cast, "laptop"):
        every = f"every {source.interval:.0f} s"
        yield f"telemetry {name} of the {role}: the laptop runs {every}: {quote(source.argv())}"
