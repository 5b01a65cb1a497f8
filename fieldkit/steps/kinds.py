"""The kinds of step that a procedure can name: fieldkit's own, and those of entry points."""

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from fieldkit.core.errors import ConfigurationError

if TYPE_CHECKING:
    from fieldkit.steps.base import Step

ENTRY_POINTS: Final = "fieldkit.steps"
"""Group of the entry points that name further kinds: `NAME = "package.module:Class"`, a `Step`."""

_OWN: Final = MappingProxyType(
    {
        "record": "RecordStep",
        "capture": "CaptureStep",
        "transfer": "TransferStep",
        "ping": "PingStep",
        "fault": "FaultStep",
        "move": "MoveStep",
    }
)
"""Class by kind, in the module `fieldkit.steps.KIND`; in the order in which messages list them."""

_REMEDY: Final = "mend or uninstall its package"


@cache
def known() -> Mapping[str, "type[Step]"]:
    """Return every kind of step by name; one of an entry point does not replace fieldkit's own.

    Raises:
        ConfigurationError: An entry point names what cannot be loaded, no `Step`, or a kind that there is already.
    """
    base = import_module("fieldkit.steps.base")  # which imports this module
    found: dict[str, type[Step]] = {
        kind: getattr(import_module(f"fieldkit.steps.{kind}"), name) for kind, name in _OWN.items()
    }
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda one: one.name):
        where = f"entry point {point.name} = {point.value}"
        if point.name in found:
            raise ConfigurationError(
                f"there is a kind of step {point.name!r} already", where=where, remedy="uninstall it, or rename it"
            )
        try:
            loaded = point.load()
        except (ImportError, AttributeError) as error:
            raise ConfigurationError(
                f"a kind of step cannot be loaded: {error}", where=where, remedy=_REMEDY
            ) from error
        if not (isinstance(loaded, type) and issubclass(loaded, base.Step)):
            raise ConfigurationError("a kind of step is a subclass of Step", where=where, remedy=_REMEDY)
        found[point.name] = loaded
    return MappingProxyType(found)
