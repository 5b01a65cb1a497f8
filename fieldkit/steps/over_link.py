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
"""Interface of a link whose address belongs to no radio; routes select the radio that carries packets to it."""

ANY: Final = "any"
"""tcpdump's name for all interfaces together."""

_DEVICE: Final = re.compile(r"\bdev (?P<interface>\S{1,30})", re.ASCII)


class OverLink(Strict):
    """Base class of steps that can use a link other than the radio under test.

    Attributes:
        over: Link over which it sends, by its name in [the profiles of the robots](links.md); without it, the radio
            under test.
    """

    over: LinkName = Field(default="", exclude_if=schema.is_empty)

    def capture_interface(self, scene: Scene, role: Role) -> str:
        """Return the interface on which the link is captured; `any` if its packets may use any interface."""
        interface = scene.link(role, self.over).interface
        return ANY if interface == LOOPBACK else interface

    def route_needs(self, scene: Scene, first: Role, second: Role) -> Iterator[Need]:
        """Yield the checks that the routes between two robots use this link, in both directions.

        There is no check for the radio under test, nor for a link whose packets may use any interface.
        """
        for source, destination in ((first, second), (second, first)):
            source_link, destination_link = scene.link(source, self.over), scene.link(destination, self.over)
            if self.over and source_link.interface != LOOPBACK:
                argv = ("ip", "-o", "route", "get", destination_link.address)
                judge = partial(judge_route, source_link, destination_link)
                yield Need(source, f"route over {self.over}", argv, judge)


def judge_route(
    source_link: RobotLink, destination_link: RobotLink, result: CommandResult
) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the output of `ip route get`."""
    match = _DEVICE.search(result.text) if result.ok else None
    remedy = f"sudo ip route replace {destination_link.address} dev {source_link.interface}"
    if match is None:
        return Verdict.FAIL, f"no route to {destination_link.address}: {result.text}", remedy
    if match["interface"] != source_link.interface:
        return (
            Verdict.FAIL,
            f"packets to {destination_link.address} leave by {match['interface']}, not {source_link.interface}",
            remedy,
        )
    return Verdict.OK, f"{destination_link.address} by {source_link.interface}", ""
