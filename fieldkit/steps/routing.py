"""Preflight check that every robot runs a routing protocol, if robots forward packets for each other."""

from collections.abc import Iterator
from typing import Final

from fieldkit.core.model import Verdict
from fieldkit.steps.scene import CommandResult, Need, Scene

DAEMONS: Final = ("babeld", "bird", "olsrd", "olsrd2", "bmx7", "batmand")
"""Routing daemons for ad-hoc networks in Debian and OpenWrt, by process name."""

# Two other routing protocols have no process: batman-adv is a kernel module, and in 802.11s the driver forwards
# packets.
_SEARCH_SCRIPT: Final = """
for file in /proc/[0-9]*/comm; do
    { read -r name <"$file"; } 2>/dev/null || continue
    for daemon; do [ "$name" = "$daemon" ] && echo "$name"; done
done
[ ! -d /sys/module/batman_adv ] || echo batman-adv
PATH=$PATH:/usr/sbin:/sbin
iw dev "$interface" info 2>/dev/null | grep -q 'type mesh point' && echo 802.11s
true
"""


def needs(scene: Scene) -> Iterator[Need]:
    """Yield the check for a routing protocol on each robot of the scene, including robots without a step."""
    for role, robot in scene.cast.items():
        script = f"interface=$1; shift{_SEARCH_SCRIPT}"
        yield Need(role, "routing", ("sh", "-c", script, "sh", robot.profile.radio.interface, *DAEMONS), judge)


def judge(answer: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the names of the routing protocols on a robot."""
    protocols = list(dict.fromkeys(answer.text.split()))
    if answer.ok and protocols:
        return Verdict.OK, ", ".join(protocols), ""
    problem = "no routing protocol runs on it: no daemon such as babeld, no batman-adv, no 802.11s"
    return Verdict.FAIL, problem, "start one on each robot, see: fieldkit docs mesh"
