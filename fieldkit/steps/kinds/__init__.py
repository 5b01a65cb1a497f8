"""The kinds of step that a procedure can name: fieldkit's own, and those of entry points."""

from collections.abc import Iterator
from importlib.metadata import EntryPoint
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError

_OWN: Final = MappingProxyType(
    {
        "record": "RecordStep",
        "capture": "CaptureStep",
        "transfer": "TransferStep",
        "ping": "PingStep",
        "fault": "FaultStep",
        "move": "MoveStep",
        "wait": "WaitStep",
        "ask": "AskStep",
        "together": "TogetherStep",
        "run": "RunStep",
        "iperf3": "Iperf3Step",
        "soak": "SoakStep",
        "send": "SendStep",
        "track": "TrackStep",
        "topics": "TopicsStep",
        "mavlink": "MavlinkStep",
        "fly": "FlyStep",
    }
)
"""Class by kind, in the module of this room that is called like it; in the order in which messages list them."""


def own() -> frozenset[str]:
    """Return the names of fieldkit's own kinds."""
    return frozenset(_OWN)


def load() -> Iterator[tuple[EntryPoint, Any]]:
    """Yield every kind of step and what stands for it, fieldkit's own first.

    Raises:
        ConfigurationError: An entry point names what cannot be loaded, or a kind that there is already.
    """
    taken = set()
    own = [EntryPoint(kind, f"fieldkit.steps.kinds.{kind}:{name}", plugins.STEPS) for kind, name in _OWN.items()]
    for point in (*own, *plugins.points(plugins.STEPS)):
        if point.name in taken:
            raise ConfigurationError(
                f"there is a kind of step {point.name!r} already",
                where=plugins.where(point),
                remedy="uninstall it, or rename it",
            )
        taken.add(point.name)
        yield point, plugins.load(point)
