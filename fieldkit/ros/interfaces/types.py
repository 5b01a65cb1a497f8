"""ROS message types by name: definitions, MD5 sums of ROS 1, type hashes of ROS 2, and fields.

rosbags contains the standard types of ROS except tf2_msgs. The types of tf2_msgs and the custom types of a lab are
parsed from their definitions. The MD5 sum is defined by gentools (wiki.ros.org/ROS/Technical Overview). The type hash
is RIHS01 of REP-2016: SHA-256 of the type's description as JSON.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from types import MappingProxyType
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.ros.interfaces.definitions import EXTRA_DEFINITIONS

_HEADER: Final = "std_msgs/msg/Header"


class Distribution(StrEnum):
    """A distribution of ROS 2, whose types are used over DDS and Zenoh."""

    FOXY = "foxy"
    GALACTIC = "galactic"
    HUMBLE = "humble"
    IRON = "iron"
    JAZZY = "jazzy"
    KILTED = "kilted"

    @classmethod
    def of(cls, name: str) -> "Distribution":
        """Return the distribution with this name, or the newest one for an unknown name such as `rolling`."""
        return cls(name) if name in list(cls) else list(cls)[-1]

    @property
    def has_type_hashes(self) -> bool:
        """Whether its nodes announce type hashes, which were introduced in Iron (REP-2016)."""
        return self not in {Distribution.FOXY, Distribution.GALACTIC, Distribution.HUMBLE}

    @property
    def gid_bytes(self) -> int:
        """Length of a GID (global identifier of an endpoint) in the messages of its rmw_dds_common, in bytes."""
        return 16 if self.has_type_hashes else 24


_STORES: Final = MappingProxyType({distribution: Stores(f"ros2_{distribution}") for distribution in Distribution})


@dataclass(frozen=True)
class MessageField:
    """A member of a message.

    Attributes:
        name: Its name.
        type: A primitive type (`float32`, `string`), or the name of a message type (`std_msgs/msg/Header`).
        count: None for a single value, N for an array of N values, 0 for an unbounded sequence, or -N for a sequence
            of at most N values.
    """

    name: str
    type: str
    count: int | None


@dataclass(frozen=True)
class MessageType:
    """A message type in ROS 1 and ROS 2.

    Attributes:
        name: Its name, for example `sensor_msgs/msg/LaserScan`.
        definition: Its definition with all nested types, in the format of ROS 1; empty if ROS 1 has no such type.
        md5: Its MD5 sum in ROS 1; empty if ROS 1 has no such type.
        rihs01: Its hash in ROS 2, `RIHS01_` and 64 hexadecimal digits; empty if ROS 2 has no such type.
    """

    name: str
    definition: str
    md5: str
    rihs01: str


class MessageTypes:
    """The standard message types, and the custom types of a lab.

    Args:
        distribution: Distribution of ROS 2.
        definitions: Definitions of the custom types by name, `lab_msgs/msg/Radio` or `lab_msgs/Radio`.

    Attributes:
        ros1: The types in ROS 1 Noetic.
        ros2: The types in ROS 2.
        distribution: Distribution of ROS 2.

    Raises:
        ConfigurationError: A definition is invalid, or contains an unknown type.
    """

    def __init__(
        self, distribution: Distribution = Distribution.JAZZY, definitions: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        self.distribution = distribution
        self.ros1 = get_typestore(Stores.ROS1_NOETIC)
        self.ros2 = get_typestore(_STORES[distribution])
        custom = {full_name(name): text for name, text in definitions.items()}
        for store in (self.ros1, self.ros2):
            _add(store, {**EXTRA_DEFINITIONS, **custom})
        # In .msg files of ROS 2 `char` is an alias of uint8, which the hash function of rosbags ignores.
        for name, (constants, members) in list(self.ros2.fielddefs.items()):
            self.ros2.fielddefs[name] = (constants, _char_as_uint8(members))

    def get(self, name: str) -> MessageType:
        """Return a type by its name, in the spelling of ROS 1 or ROS 2.

        Raises:
            ConfigurationError: There is no such type.
        """
        type_name = full_name(name)
        in_ros1, in_ros2 = type_name in self.ros1.fielddefs, type_name in self.ros2.fielddefs
        if not in_ros1 and not in_ros2:
            raise self._unknown_type_error(type_name)
        definition, md5 = self.ros1.generate_msgdef(type_name, ros_version=1) if in_ros1 else ("", "")
        return MessageType(type_name, definition, md5, self.ros2.hash_rihs01(type_name) if in_ros2 else "")

    def fields(self, name: str) -> Mapping[str, tuple[MessageField, ...]]:
        """Return the members of a type of ROS 2 and of all its nested types, by type name. The type is the first key.

        Raises:
            ConfigurationError: ROS 2 has no such type.
        """
        types: dict[str, tuple[MessageField, ...]] = {}
        pending = [full_name(name)]
        while pending:
            kind = pending.pop(0)
            if kind in types:
                continue
            if kind not in self.ros2.fielddefs:
                raise self._unknown_type_error(kind)
            types[kind] = tuple(_field(*member) for member in self.ros2.fielddefs[kind][1])
            pending += [member.type for member in types[kind] if "/" in member.type]
        return types

    def is_translatable(self, type_name: str) -> bool:
        """Return True if the type is the same in ROS 1 and ROS 2, except for `seq` of headers."""
        return all(
            name == _HEADER
            or (
                name in self.ros1.fielddefs
                and _char_as_uint8(_member_types(self.ros1, name)) == _member_types(self.ros2, name)
            )
            for name in self.fields(type_name)
        )

    def adds_at_end(self, type_name: str, names: tuple[str, ...]) -> bool:
        """Return True if a type of ROS 2 has the members of ROS 1, followed by members with exactly these names."""
        key = full_name(type_name)
        ros1_members, ros2_members = _char_as_uint8(self.ros1.fielddefs[key][1]), self.ros2.fielddefs[key][1]
        common, additional = ros2_members[: -len(names)], ros2_members[-len(names) :]
        return common == ros1_members and tuple(name for name, _ in additional) == names

    def _unknown_type_error(self, name: str) -> ConfigurationError:
        type_names = self.ros1.fielddefs.keys() | self.ros2.fielddefs.keys()
        names_by_suffix = {type_name.rpartition("/")[2]: type_name for type_name in type_names}
        remedy = did_you_mean(name, names_by_suffix.values(), "give its definition")
        return ConfigurationError(f"there is no message type {name}", remedy=remedy)


@cache
def standard_types(distribution: Distribution = Distribution.JAZZY) -> MessageTypes:
    """Return the standard types of ROS, without custom types."""
    return MessageTypes(distribution)


def full_name(name: str) -> str:
    """Return a type name in the spelling of ROS 2, `sensor_msgs/msg/LaserScan`; unchanged if it has no package."""
    package, _, short_name = name.partition("/")
    return f"{package}/msg/{short_name}" if short_name and "/" not in short_name else name


def _add(store: Typestore, definitions: Mapping[str, str]) -> None:
    for name, text in definitions.items():
        try:
            types = get_types_from_msg(text, name)
            store.register({kind: types[kind] for kind in types if kind not in store.fielddefs})
        except (TypesysError, AssertionError, ValueError, KeyError) as error:
            raise ConfigurationError(
                f"the definition of {name} is not valid: {error}", remedy="write it as in a .msg file of ROS"
            ) from error
    for name in definitions:
        for _, description in store.fielddefs[name][1]:
            if (member := _field("", description)).type not in store.fielddefs and "/" in member.type:
                raise ConfigurationError(
                    f"the definition of {name} contains the unknown type {member.type}", remedy="define it, too"
                )


def _member_types(store: Typestore, name: str) -> list[Any]:
    """Return the descriptions of the members of a type, without names."""
    return [description for _, description in store.fielddefs[name][1]]


def _char_as_uint8(node: Any) -> Any:  # noqa: ANN401 (a recursive type of rosbags)
    """Return rosbags' description of members (nested lists and tuples) with `char` replaced by `uint8`."""
    if isinstance(node, list):
        return [_char_as_uint8(part) for part in node]
    if not isinstance(node, tuple):
        return node
    return ("uint8", 0) if node == ("char", 0) else tuple(map(_char_as_uint8, node))


def _field(name: str, description: Any) -> MessageField:  # noqa: ANN401 (a recursive type of rosbags)
    """Return the member that rosbags describes as a tuple of node type and content."""
    kind, content = description
    if kind == Nodetype.BASE:
        return MessageField(name, content[0], None)
    if kind == Nodetype.NAME:
        return MessageField(name, content, None)
    (inner, element_type), count = content
    element = element_type[0] if inner == Nodetype.BASE else element_type
    return MessageField(name, element, count if kind == Nodetype.ARRAY else -count)
