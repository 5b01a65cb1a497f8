"""Indices of a robot's network interfaces, which captures on all interfaces contain instead of names."""

import re
from collections.abc import Mapping
from typing import Final

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import snapshots
from fieldkit.measure.robot_state.snapshots import Snapshot

NAME: Final = "interfaces"
"""Name of the source with the output of `ip -o link`."""

# After the name of a virtual Ethernet interface, ip prints its peer: `3: wlan0@if9: <BROADCAST,...`.
_INTERFACE: Final = re.compile(r"^([1-9][0-9]{0,9}): ([^\s:@/]{1,15})(?:@[^\s:]{1,15})?: <", re.MULTILINE | re.ASCII)


def parse(snapshot: Snapshot) -> dict[str, int]:
    """Return the index of each interface by its name; empty if the source has no value."""
    output = snapshot.get(NAME)
    text = "" if output is None or output.failure else output.text
    return {name: int(index) for index, name in _INTERFACE.findall(text)}


def read_indices(evidence: AttemptEvidence, role: Role) -> Mapping[str, int]:
    """Return the indices of the interfaces that had the same index before and after an attempt."""
    before, after = map(parse, snapshots.read_attempt(evidence, role))
    return {name: index for name, index in before.items() if after.get(name) == index}
