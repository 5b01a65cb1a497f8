"""Preflight of robots that forward for each other: whether something on them finds the ways."""

from collections.abc import Iterator
from typing import Final

from fieldkit.core.model import Verdict
from fieldkit.steps.scene import Need, Said, Scene

DAEMONS: Final = ("babeld", "bird", "olsrd", "olsrd2", "bmx7", "batmand")
"""Routing daemons of ad-hoc networks in Debian and OpenWrt, as the kernel names their processes."""

# Two others are no process: batman-adv is a module of the kernel, and stations of 802.11s forward by themselves.
_LOOK: Final = """
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
    """Yield that each robot of the scene takes part in a mesh, those too that no step names."""
    for role, robot in scene.cast.items():
        script = f"interface=$1; shift{_LOOK}"
        yield Need(role, "routing", ("sh", "-c", script, "sh", robot.profile.radio.interface, *DAEMONS), judged)


def judged(answer: Said) -> tuple[Verdict, str, str]:
    """Return what it is worth that these were found, a word each."""
    found = list(dict.fromkeys(answer.text.split()))
    if answer.ok and found:
        return Verdict.OK, ", ".join(found), ""
    lack = "nothing on it finds ways over others: no babeld or the like runs, no batman-adv, no 802.11s"
    return Verdict.FAIL, lack, "start one on each robot, see: fieldkit docs mesh"
