"""Templates for messages of any ROS 1 type: constant bytes before and after one list of numbers.

The lab computes a template from the definition of the type, with rosbags. The robot fills the list in each message,
so it needs no parser of definitions. In the constant bytes, numbers are 0, strings are empty, and quaternions are the
identity. The fields that describe an image, a compressed image or a point cloud are set.
"""

import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from fieldkit.config.profiles import PublishedTopic
from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.emulated.ros.message_definitions import full_name, types_with
from sim_backends.emulated.ros.sensor_specs import GENERATED_TYPES, Template, packed_string

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_HEADER: Final = "std_msgs/msg/Header"
_QUATERNION: Final = "geometry_msgs/msg/Quaternion"
# Format characters of `struct`. Times are missing, because rosbags treats a time as a type with two fields.
_STRUCT_FORMATS: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "octet": "B",
    "int8": "b",
    "int16": "h",
    "int32": "i",
    "int64": "q",
    "uint8": "B",
    "uint16": "H",
    "uint32": "I",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_POINT_BYTES: Final = 16
"""Length of a point in a PointCloud2: four float32 fields."""
_FLOAT32: Final = 7  # sensor_msgs/PointField.FLOAT32

Values = Mapping[str, bytes]
"""Serialized values of fields that are not zero or empty, by name."""


def template_of(topic: PublishedTopic) -> Template:
    """Return the template of a topic's messages.

    Raises:
        ConfigurationError: The definition is missing or cannot be parsed, or no list can have the required size.
    """
    fields = _SerializedFields(types_with(topic.type, topic.definition), topic.payload_bytes, _field_values(topic))
    try:
        has_header = fields.add_message(full_name(topic.type))
    except KeyError as error:
        raise _unknown_type_error(topic) from error
    if topic.payload_bytes and fields.list_type is None:
        raise ConfigurationError(
            f"{topic.type} has no list of numbers whose size can be {topic.payload_bytes} bytes",
            where=f"topic {topic.name}",
            remedy="remove size, or make it a multiple of a number's bytes",
        )
    floats = fields.list_type == "float32" or topic.type == "sensor_msgs/PointCloud2"
    head, tail = (part.hex() for part in fields.parts)
    return Template(has_header, head, tail, topic.payload_bytes, floats)


def _field_values(topic: PublishedTopic) -> Values:
    values_of = _VALUES.get(topic.type)
    return values_of(topic) if values_of else {}


def _unknown_type_error(topic: PublishedTopic) -> ConfigurationError:
    remedy = f"write what `rosmsg show -r {topic.type}` prints under definition: of the topic"
    return ConfigurationError(
        f"an emulated robot cannot publish {topic.type}: ROS 1 has no definition of this type, or of a type in it",
        where=f"topic {topic.name}",
        remedy=f"{did_you_mean(topic.type, GENERATED_TYPES, remedy)}",
    )


class _SerializedFields:
    """Serialized fields in order, with a gap for the first list of numbers.

    Args:
        store: Type definitions.
        size_bytes: Size of the list; 0 for an empty one.
        values: Values of fields of the outermost message.

    Attributes:
        parts: The fields before and after the gap; all fields are before it if there is no gap.
        list_type: Type of the numbers in the gap; None if there is no gap yet.
    """

    def __init__(self, store: "Typestore", size_bytes: int, values: Values) -> None:
        self.parts: tuple[bytearray, bytearray] = (bytearray(), bytearray())
        self.list_type: str | None = None
        self._store = store
        self._size_bytes = size_bytes
        self._values = values

    def add_message(self, kind: str) -> bool:
        """Add every field of the outermost message except its header; return True if it has a header."""
        _, fields = self._store.fielddefs[kind]
        # Each field is (name, (kind of node, argument)).
        has_header = bool(fields) and fields[0][1][1] == _HEADER
        for name, field in fields[1:] if has_header else fields:
            if name in self._values:
                self._add(self._values[name])
            else:
                self._add_field(*field)
        return has_header

    def _add(self, data: bytes) -> None:
        before_list, after_list = self.parts
        (before_list if self.list_type is None else after_list).extend(data)

    def _add_field(self, node: Any, argument: Any) -> None:  # noqa: ANN401 (rosbags' own tuples)
        """Add a field with the value 0 or empty; a quaternion is the identity."""
        match node.name:
            case "BASE":
                self._add(
                    bytes(4) if argument[0] == "string" else bytes(struct.calcsize(_STRUCT_FORMATS[argument[0]]))
                )
            case "NAME" if argument == _QUATERNION:
                self._add(struct.pack("<4d", 0, 0, 0, 1))
            case "NAME":
                for _, field in self._store.fielddefs[argument][1]:
                    self._add_field(*field)
            case "ARRAY":
                for _ in range(argument[1]):
                    self._add_field(*argument[0])
            case _:
                self._add_list(*argument[0])

    def _add_list(self, node: Any, argument: Any) -> None:  # noqa: ANN401 (as above)
        """Add a list. The first list of numbers that can have the required size becomes the gap; others are empty."""
        if self.list_type is not None or not self._size_bytes or node.name != "BASE" or argument[0] == "string":
            self._add(bytes(4))  # an empty list
            return
        item_bytes = struct.calcsize(_STRUCT_FORMATS[argument[0]])
        if self._size_bytes % item_bytes:
            self._add(bytes(4))
            return
        self._add(struct.pack("<I", self._size_bytes // item_bytes))
        self.list_type = argument[0]


def _image(topic: PublishedTopic) -> Values:
    width, height = topic.width or 0, topic.height or 0
    numbers = {"height": height, "width": width, "step": 3 * width}
    return {name: struct.pack("<I", value) for name, value in numbers.items()} | {"encoding": packed_string("rgb8")}


def _compressed_image(_: PublishedTopic) -> Values:
    return {"format": packed_string("jpeg")}


def _point_cloud(topic: PublishedTopic) -> Values:
    points = topic.points or 0
    names = ("x", "y", "z", "intensity")
    fields = [packed_string(name) + struct.pack("<IBI", 4 * index, _FLOAT32, 1) for index, name in enumerate(names)]
    numbers = {"height": 1, "width": points, "point_step": _POINT_BYTES, "row_step": _POINT_BYTES * points}
    values = {name: struct.pack("<I", value) for name, value in numbers.items()}
    return values | {"fields": struct.pack("<I", len(fields)) + b"".join(fields), "is_dense": b"\x01"}


_VALUES: Final = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/PointCloud2": _point_cloud,
}
