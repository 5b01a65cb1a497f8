"""The page of the classes of the co-simulation that other packages implement or receive, from their docstrings."""

import inspect
import re
from collections.abc import Iterator
from typing import Final

from docs.generator.markdown import page, table
from fieldkit.config.documentation import attribute_meanings, class_description
from sim_backends.cosim.policies.sync_policy import Situation, SyncPolicy
from sim_backends.federates.protocols import NetworkFederate, PhysicsFederate
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.motion import State

_HEADING: Final = re.compile(r"^(?:Args|Returns|Raises):$", re.MULTILINE)
_ENTRY: Final = re.compile(r"^    (\w+): ", re.MULTILINE)
_CLASSES: Final = (SyncPolicy, Situation, PhysicsFederate, NetworkFederate, State, Packet, Arrival, Drop)


def cosim_protocols() -> str:
    """Return the page."""
    sections = (
        block
        for described in _CLASSES
        for block in (
            f"## {described.__name__}",
            f"`{described.__module__}`. {class_description(described)}",
            table(("member", "meaning"), _members(described)),
        )
    )
    return page(
        "Classes of the co-simulation",
        "Members of the classes that a [sync policy, physics or network simulator of your own](../cosim-api.md) "
        "implements or receives. Times are nanoseconds of simulated time.",
        *sections,
    )


def _members(described: type) -> Iterator[tuple[str, str]]:
    """Yield each attribute, property and method of a class with its meaning."""
    for name, meaning in attribute_meanings(described).items():
        yield f"`{name}`", meaning
    for name, member in vars(described).items():
        if name.startswith("_"):
            continue
        if isinstance(member, property):
            yield f"`{name}`", _in_one_line(member)
        elif inspect.isfunction(member):
            yield f"`{name}({', '.join(list(inspect.signature(member).parameters)[1:])})`", _in_one_line(member)


def _in_one_line(documented: object) -> str:
    """Return a docstring in a line, with the names of arguments as code."""
    text = _HEADING.sub("", inspect.getdoc(documented) or "")
    return " ".join(_ENTRY.sub(r"`\1`: ", text).split())
