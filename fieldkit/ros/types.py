"""ROS message types by name: definitions, the MD5 sum of ROS 1, the type hash of ROS 2, and their fields.

Types that ROS ships come with rosbags; tf2_msgs, which it lacks, and types of a lab's own are made from the text of
their definition. The MD5 sum is that of gentools (wiki.ros.org/ROS/Technical Overview), the type hash RIHS01 that of
REP-2016: SHA-256 over the type's description as JSON.
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

from fieldkit.core.errors import ConfigurationError, nearest

LACKING: Final[Mapping[str, str]] = MappingProxyType(
    {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}
)
"""Types of every robot that rosbags does not know."""


_HEADER: Final = "std_msgs/msg/Header"


class Distribution(StrEnum):
    """A distribution of ROS 2, whose types are spoken over DDS and Zenoh."""

    FOXY = "foxy"
    GALACTIC = "galactic"
    HUMBLE = "humble"
    IRON = "iron"
    JAZZY = "jazzy"
    KILTED = "kilted"

    @classmethod
    def of(cls, name: str) -> "Distribution":
        """Return the distribution of a name; the newest for one that is not known, such as `rolling`."""
        return cls(name) if name in list(cls) else list(cls)[-1]

    @property
    def tells_hashes(self) -> bool:
        """Whether its nodes tell others the hashes of types, which came with Iron (REP-2016)."""
        return self not in {Distribution.FOXY, Distribution.GALACTIC, Distribution.HUMBLE}

    @property
    def gid_bytes(self) -> int:
        """How long the name of an endpoint is in its rmw_dds_common."""
        return 16 if self.tells_hashes else 24


_STORES: Final = MappingProxyType({one: Stores(f"ros2_{one}") for one in Distribution})


@dataclass(frozen=True)
class MessageField:
    """One member of a message.

    Attributes:
        name: Its name.
        type: A type of the language (`float32`, `string`), or the name of a message type, `std_msgs/msg/Header`.
        count: None for one, 0 for a sequence, else the length of an array; less than 0, the bound of a sequence.
    """

    name: str
    type: str
    count: int | None


@dataclass(frozen=True)
class MessageType:
    """A message type in both generations of ROS.

    Attributes:
        name: `sensor_msgs/msg/LaserScan`.
        definition: Its text as nodes of ROS 1 tell it, with the types that it is made of; empty where ROS 1 has none.
        md5: Its sum there; empty where ROS 1 has none.
        rihs01: Its hash in ROS 2, `RIHS01_` and 64 hexadecimal digits; empty where ROS 2 has none.
    """

    name: str
    definition: str
    md5: str
    rihs01: str


class MessageTypes:
    """The message types that a lab knows.

    Args:
        distribution: Of ROS 2.
        definitions: Text of each type of the lab's own by name, `lab_msgs/msg/Radio` or `lab_msgs/Radio`.

    Attributes:
        ros1: The types in ROS 1, Noetic.
        ros2: The types in ROS 2.
        distribution: Of that.

    Raises:
        ConfigurationError: A definition is none, or names a type that there is not.
    """

    def __init__(
        self, distribution: Distribution = Distribution.JAZZY, definitions: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        self.distribution = distribution
        self.ros1 = get_typestore(Stores.ROS1_NOETIC)
        self.ros2 = get_typestore(_STORES[distribution])
        own = {full_name(name): text for name, text in definitions.items()}
        for store in (self.ros1, self.ros2):
            _add(store, {**LACKING, **own})
        # In a .msg file of ROS 2 `char` is another name of uint8, which rosbags' hash does not know.
        for name, (constants, members) in list(self.ros2.fielddefs.items()):
            self.ros2.fielddefs[name] = (constants, _char_as_uint8(members))

    def get(self, name: str) -> MessageType:
        """Return a type by its name, in the spelling of either generation.

        Raises:
            ConfigurationError: There is none.
        """
        full = full_name(name)
        of_ros1, of_ros2 = full in self.ros1.fielddefs, full in self.ros2.fielddefs
        if not of_ros1 and not of_ros2:
            raise self._unknown(full)
        definition, md5 = self.ros1.generate_msgdef(full, ros_version=1) if of_ros1 else ("", "")
        return MessageType(full, definition, md5, self.ros2.hash_rihs01(full) if of_ros2 else "")

    def fields(self, name: str) -> Mapping[str, tuple[MessageField, ...]]:
        """Return the members of a type in ROS 2, and of every type that it is made of, by name; itself first.

        Raises:
            ConfigurationError: ROS 2 has no such type.
        """
        found: dict[str, tuple[MessageField, ...]] = {}
        waiting = [full_name(name)]
        while waiting:
            kind = waiting.pop(0)
            if kind in found:
                continue
            if kind not in self.ros2.fielddefs:
                raise self._unknown(kind)
            found[kind] = tuple(_field(*member) for member in self.ros2.fielddefs[kind][1])
            waiting += [member.type for member in found[kind] if "/" in member.type]
        return found

    def translatable(self, type_name: str) -> bool:
        """Return whether a message of this type in one ROS is one of the other, but for `seq` of headers."""
        return all(
            name == _HEADER
            or (name in self.ros1.fielddefs and _char_as_uint8(_kinds(self.ros1, name)) == _kinds(self.ros2, name))
            for name in self.fields(type_name)
        )

    def adds_at_end(self, type_name: str, names: tuple[str, ...]) -> bool:
        """Return whether a type of ROS 2 has the members of ROS 1's, and after them just those of these names."""
        full = full_name(type_name)
        of_ros1 = _char_as_uint8(self.ros1.fielddefs[full][1])
        common, added = self.ros2.fielddefs[full][1][: -len(names)], self.ros2.fielddefs[full][1][-len(names) :]
        return common == of_ros1 and tuple(name for name, _ in added) == names

    def _unknown(self, name: str) -> ConfigurationError:
        known = self.ros1.fielddefs.keys() | self.ros2.fielddefs.keys()
        last = {full.rpartition("/")[2]: full for full in known}
        remedy = nearest(name, last.values(), "give its definition")
        return ConfigurationError(f"there is no message type {name}", remedy=remedy)


@cache
def shipped(distribution: Distribution = Distribution.JAZZY) -> MessageTypes:
    """Return the types that ROS ships."""
    return MessageTypes(distribution)


def full_name(name: str) -> str:
    """Return `sensor_msgs/msg/LaserScan` for either spelling of it."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def _add(store: Typestore, definitions: Mapping[str, str]) -> None:
    for name, text in definitions.items():
        try:
            found = get_types_from_msg(text, name)
            store.register({kind: found[kind] for kind in found if kind not in store.fielddefs})
        except (TypesysError, AssertionError, ValueError, KeyError) as error:
            raise ConfigurationError(
                f"the definition of {name} is none: {error}", remedy="write it as in a .msg file of ROS"
            ) from error
    for name in definitions:
        for _, description in store.fielddefs[name][1]:
            if (member := _field("", description)).type not in store.fielddefs and "/" in member.type:
                raise ConfigurationError(
                    f"the definition of {name} names {member.type}, which there is not", remedy="define it, too"
                )


def _kinds(store: Typestore, name: str) -> list[Any]:
    """Return the descriptions of a type's members, without their names."""
    return [description for _, description in store.fielddefs[name][1]]


def _char_as_uint8(node: Any) -> Any:  # noqa: ANN401 (of rosbags, whose own type is recursive)
    """Return a description of members, tuples in lists, with one type of the language for another."""
    if isinstance(node, list):
        return [_char_as_uint8(part) for part in node]
    if not isinstance(node, tuple):
        return node
    return ("uint8", 0) if node == ("char", 0) else tuple(map(_char_as_uint8, node))


def _field(name: str, description: Any) -> MessageField:  # noqa: ANN401 (of rosbags, whose own type is recursive)
    """Return a member as rosbags describes it: a kind of node, and what it is of."""
    kind, of = description
    if kind == Nodetype.BASE:
        return MessageField(name, of[0], None)
    if kind == Nodetype.NAME:
        return MessageField(name, of, None)
    (inner, what), count = of
    element = what[0] if inner == Nodetype.BASE else what
    return MessageField(name, element, count if kind == Nodetype.ARRAY else -count)
