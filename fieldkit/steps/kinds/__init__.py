"""The kinds of step: built-in kinds, and kinds of entry points."""

from collections.abc import Mapping
from importlib.metadata import EntryPoint
from types import MappingProxyType
from typing import Final

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError

_PACKAGE: Final = "fieldkit"
_BUILTIN_CLASSES: Final = MappingProxyType(
    {
        "capture": "CaptureStep",
        "transfer": "TransferStep",
        "ping": "PingStep",
        "fault": "FaultStep",
        "wait": "WaitStep",
        "ask": "AskStep",
        "together": "TogetherStep",
        "run": "RunStep",
        "iperf3": "Iperf3Step",
        "soak": "SoakStep",
        "send": "SendStep",
        "roam": "RoamStep",
    }
)
"""Class of each built-in kind. The kind is also the name of its module in this package. Messages list the kinds in
this order."""


def builtin_names() -> frozenset[str]:
    """Return the names of the built-in kinds."""
    return frozenset(_BUILTIN_CLASSES)


def shipped_names() -> frozenset[str]:
    """Return the names of the kinds that ship with fieldkit: built-in kinds, and kinds of its own entry points."""
    points = plugins.entry_points(plugins.STEPS)
    return builtin_names() | {
        point.name for point in points if point.dist is not None and point.dist.name == _PACKAGE
    }


def find() -> Mapping[str, EntryPoint]:
    """Return the entry point of every kind of step by name, built-in kinds first, without importing any of them.

    Raises:
        ConfigurationError: The name of an entry point is already used.
    """
    points = {
        kind: EntryPoint(kind, f"{__name__}.{kind}:{name}", plugins.STEPS) for kind, name in _BUILTIN_CLASSES.items()
    }
    for point in plugins.entry_points(plugins.STEPS):
        if point.name in points:
            raise ConfigurationError(
                f"there is already a kind of step {point.name!r}",
                where=plugins.location(point),
                remedy="uninstall this package, or rename its kind of step",
            )
        points[point.name] = point
    return MappingProxyType(points)
