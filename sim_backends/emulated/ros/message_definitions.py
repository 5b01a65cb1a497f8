"""Definitions of ROS 1 message types, from rosbags or from the profile of a robot."""

from functools import cache
from typing import TYPE_CHECKING

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.ros.sensor_specs import Definition

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


def definition_of(kind: str, text: str) -> Definition:
    """Return the definition that a publisher of the type `package/Name` announces; `text` is used if ROS has none.

    ROS or `text` must define the type and all types in it; `template_of` checks this.

    Raises:
        ConfigurationError: `text` cannot be parsed.
    """
    return Definition(*types_with(kind, text).generate_msgdef(full_name(kind), ros_version=1))


def full_name(kind: str) -> str:
    """Return the name of a type in rosbags: `package/msg/Name` for `package/Name`."""
    return kind.replace("/", "/msg/")


@cache
def types_with(kind: str, definition: str) -> "Typestore":
    """Return ROS 1's types and the types in a definition.

    The definition has the fields of the type, then `MSG: package/Name` and the fields of each type in it.
    """
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore  # noqa: PLC0415 (slow)

    from fieldkit.ros.interfaces.definitions import EXTRA_DEFINITIONS  # noqa: PLC0415 (as above)

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in EXTRA_DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    if definition:
        try:
            types = get_types_from_msg(definition, full_name(kind))
            store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
        except TypesysError as error:
            raise ConfigurationError(
                f"the definition of {kind} cannot be read: {error}",
                remedy=f"write what `rosmsg show -r {kind}` prints",
            ) from error
    return store
