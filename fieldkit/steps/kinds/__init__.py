"""The kinds of step: the built-in ones, and those of entry points."""

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
"""Class of each built-in kind, in the module of that name in this package; in the order of messages."""


def builtin() -> frozenset[str]:
    """Return the names of the built-in kinds."""
    return frozenset(_OWN)


def load() -> Iterator[tuple[EntryPoint, Any]]:
    """Yield every kind of step as its entry point and its loaded object, built-in kinds first.

    Raises:
        ConfigurationError: An entry point cannot be loaded, or its name is already used.
    """
    used_names = set()
    builtin = [EntryPoint(kind, f"fieldkit.steps.kinds.{kind}:{name}", plugins.STEPS) for kind, name in _OWN.items()]
    for point in (*builtin, *plugins.entry_points(plugins.STEPS)):
        if point.name in used_names:
            raise ConfigurationError(
                f"there is already a kind of step {point.name!r}",
                where=plugins.location(point),
                remedy="uninstall it, or rename it",
            )
        used_names.add(point.name)
        yield point, plugins.load(point)
