"""Steps that send over one of several links of the robots."""

import re
from collections.abc import Iterator
from functools import partial
from typing import Final

from fieldkit.backends.protocols import RobotLink
from fieldkit.config import schema
from fieldkit.config.profiles import LinkName
from fieldkit.config.schema import Field, Strict
from fieldkit.core.model import Role, Verdict
from fieldkit.steps.scene import CommandResult, Need, Scene

LOOPBACK: Final = "lo"
"""Interface of a link whose address is reached over any other link of a robot, by the decision of its routes."""

_DEVICE: Final = re.compile(r"\bdev (?P<interface>\S{1,30})", re.ASCII)


class OverLink(Strict):
    """Base of steps that have a link.

    Attributes:
        over: Link over which it sends, by its name in [the profiles of the robots](links.md); without it, the radio
            under test.
    """

    over: LinkName = Field(default="", exclude_if=schema.is_empty)

    def route_need(self, scene: Scene, source: Role, destination: Role) -> Iterator[Need]:
        """Yield the check that the route from a robot to another uses this link.

        There is none for the radio under test, and for a link that may use any interface.
        """
        here, there = scene.link(source, self.over), scene.link(destination, self.over)
        if self.over and here.interface != LOOPBACK:
            argv = ("ip", "-o", "route", "get", there.address)
            yield Need(source, f"route over {self.over}", argv, partial(judge_route, here, there))


def judge_route(here: RobotLink, there: RobotLink, result: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the output of `ip route get`."""
    match = _DEVICE.search(result.text) if result.ok else None
    remedy = f"sudo ip route replace {there.address} dev {here.interface}"
    if match is None:
        return Verdict.FAIL, f"no route to {there.address}: {result.text}", remedy
    if match["interface"] != here.interface:
        return Verdict.FAIL, f"packets to {there.address} leave by {match['interface']}, not {here.interface}", remedy
    return Verdict.OK, f"{there.address} by {here.interface}", ""
