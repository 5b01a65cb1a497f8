"""DDS with the Python binding of CycloneDDS, the package `cyclonedds`. Only this module imports it.

Samples are passed through as bytes: the binding writes and takes serialized data (`_clayer`) in 2 us, but its
serializer needs 30 us or more. The library also needs the type of a topic, which is built member by member; other
participants receive only the name of the type.
"""

from __future__ import annotations

import ctypes
import threading
import time
from typing import Any, Callable, Mapping
from xml.sax.saxutils import escape, quoteattr

from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.internal import load_cyclonedds as loaded_library
from cyclonedds.pub import DataWriter
from cyclonedds.pub import Publisher as DdsPublisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.sub import Subscriber as DdsSubscriber
from cyclonedds.topic import Topic as DdsTopic

from fieldkit.agent.messaging import graph
from fieldkit.agent.messaging.middleware import Deliver, MiddlewareError, Network, Quality, Topic, version_of

MAX_BLOCKING_NS = 1_000_000_000
"""`max_blocking_time` of reliable writers: a write may block for this time if a reader is too slow and all samples
are kept. rmw_cyclonedds_cpp has no limit."""

_ANY_STATE = SampleState.Any | ViewState.Any | InstanceState.Any
_BATCH = 256
"""Maximum number of samples that one call takes from a reader."""
_MAX_ENDPOINTS = 4096
_OPERATION_COUNT = 14
"""Number of pointers in `struct ddsi_sertype_ops`."""
_DESCRIPTIONS = slice(8, 11)
"""Indices of `type_id`, `type_map` and `type_info` in the operations of a type."""
_WAIT_NS = 100_000_000
_UNLIMITED = -1

_PRIMITIVE_TYPES: Mapping[str, Any] = {
    "bool": bool,
    "byte": types.uint8,
    "char": types.uint8,
    "octet": types.uint8,
    "string": str,
    "wstring": str,
    "float32": types.float32,
    "float64": types.float64,
    **{
        name: getattr(types, name)
        for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
    },
}


def start(network: Network) -> DdsMiddleware:
    """Start a participant; raises `MiddlewareError` if CycloneDDS does not start."""
    return DdsMiddleware(network)


def configuration(network: Network) -> str:
    """Return the configuration of CycloneDDS: one interface, predictable ports, and discovery."""
    multicast = "true" if network.discovery == "multicast" else "false"
    settings = {
        "General/AllowMulticast": multicast,
        # Ports by the formula of RTPS, so that peers without multicast and evaluations of captures can compute them.
        "Discovery/ParticipantIndex": "auto",
        **network.settings,
    }
    peers = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in network.peers)
    fixed_elements = {
        "General": f"<Interfaces><NetworkInterface address={quoteattr(network.address)}/></Interfaces>",
        "Discovery": f"<Peers>{peers}</Peers>" if peers else "",
    }
    return f"<CycloneDDS><Domain>{_elements(settings, fixed_elements)}</Domain></CycloneDDS>"


def _elements(settings: Mapping[str, str], fixed_elements: Mapping[str, str]) -> str:
    """Return settings, whose keys are paths, as nested XML elements; `@` precedes the name of an attribute."""
    nested_settings: dict[str, dict[str, str]] = {name: {} for name in fixed_elements}
    leaves = []
    for path, value in settings.items():
        name, _, nested_path = path.partition("/")
        element, _, attribute = name.partition("@")
        if nested_path:
            nested_settings.setdefault(name, {})[nested_path] = value
        elif attribute:
            leaves.append(f"<{element} {attribute}={quoteattr(value)}/>")
        else:
            leaves.append(f"<{name}>{escape(value)}</{name}>")
    nested_elements = (
        f"<{name}>{fixed_elements.get(name, '')}{_elements(nested, {})}</{name}>"
        for name, nested in nested_settings.items()
    )
    return "".join([*leaves, *nested_elements])


def quality(qos: Quality, user_data: str, *, writes: bool) -> Qos:
    """Return a quality of service as DDS policies.

    Args:
        qos: The quality of service.
        user_data: User data of the endpoint; empty for none.
        writes: True for a writer, False for a reader.
    """
    policies = [Policy.DataRepresentation(use_cdrv0_representation=True)]
    if qos.reliability == "reliable":
        policies.append(Policy.Reliability.Reliable(MAX_BLOCKING_NS))
    elif qos.reliability == "best_effort":
        policies.append(Policy.Reliability.BestEffort)
    if qos.history == "keep_all":
        policies.append(Policy.History.KeepAll)
    elif qos.history == "keep_last" and qos.depth:
        policies.append(Policy.History.KeepLast(qos.depth))
    policies += _durability(qos, writes=writes)
    if qos.deadline_ns is not None:
        policies.append(Policy.Deadline(qos.deadline_ns))
    if qos.lifespan_ns is not None and writes:
        policies.append(Policy.Lifespan(qos.lifespan_ns))
    if user_data:
        policies.append(Policy.Userdata(user_data.encode()))
    return Qos(*policies)


def _durability(qos: Quality, *, writes: bool) -> list[Any]:
    """Return the durability policies.

    The history for late-joining readers is a separate policy, whose default depth is 1.
    """
    if qos.durability != "transient_local":
        return [Policy.Durability.Volatile] if qos.durability == "volatile" else []
    keeps_all = qos.history == "keep_all" and not qos.late_reader_depth
    depth = qos.late_reader_depth or qos.depth or 1
    history = Policy.History.KeepAll if keeps_all else Policy.History.KeepLast(depth)
    # A delay of 0 ns before samples of deleted instances are removed, and no limits of resources.
    service = [Policy.DurabilityService(0, history, *[_UNLIMITED] * 3)] if writes else []
    return [Policy.Durability.TransientLocal, *service]


def struct_type(topic: Topic) -> type:
    """Return the topic's type as a struct type of the binding."""
    return _make_struct(topic.type, topic, {})


def _make_struct(name: str, topic: Topic, struct_by_name: dict[str, type]) -> type:
    if name in struct_by_name:
        return struct_by_name[name]
    annotations: dict[str, Any] = {}
    for member, kind, count in topic.members[name]:
        value_type = _make_struct(kind, topic, struct_by_name) if kind in topic.members else _PRIMITIVE_TYPES[kind]
        if count is None:
            annotations[member] = value_type
        elif count > 0:
            annotations[member] = types.array[value_type, count]
        else:
            annotations[member] = types.sequence[value_type, -count] if count else types.sequence[value_type]
    # The binding converts dots to the double colons of IDL.
    typename = topic.dds_types[name].replace("::", ".")
    struct_by_name[name] = make_idl_struct(name.rpartition("/")[2], typename, annotations)
    return struct_by_name[name]


def padded(data: bytes) -> bytes:
    """Return a sample padded to a multiple of 4 bytes, with the number of padding bytes in its header.

    RTPS 2.5, section 10.2 (the two lowest bits of the encapsulation options; XTypes 1.3, section 7.6.3.1.2).
    """
    padding = -len(data) % 4
    return data if not padding else data[:3] + bytes([data[3] & ~3 | padding]) + data[4:] + bytes(padding)


def unpadded(data: bytes) -> bytes:
    """Return a sample without the padding of `padded`."""
    padding = data[3] & 3 if len(data) > 3 else 0
    return data if not padding else data[:3] + bytes([data[3] & ~3]) + data[4:-padding]


def hide_type_description(topic: DdsTopic) -> Any:  # noqa: ANN401 (ctypes declares no type for it)
    """Let discovery announce only the name of a topic's type; must be called before endpoints are created.

    CycloneDDS 11.0 cannot read the type descriptions of Fast DDS 3 (ROS 2 Kilted), and two endpoints that announce
    different descriptions do not match. The binding has no option to omit descriptions. Therefore, the three
    functions that return the description are removed from the type's table of functions (`struct ddsi_sertype_ops`),
    if the table has the expected layout.

    Returns:
        The table, which must not be freed before the topic; None if nothing was changed.
    """
    library = loaded_library()
    sertype = ctypes.POINTER(ctypes.c_void_p)()
    if library.dds_get_entity_sertype(topic._ref, ctypes.byref(sertype)) != 0:
        return None
    table = ctypes.cast(sertype[0], ctypes.POINTER(ctypes.c_void_p * _OPERATION_COUNT))[0]
    version = ctypes.cast(library.ddsi_sertype_v0, ctypes.c_void_p).value
    if table[0] != version or table[1] is not None or None in table[_DESCRIPTIONS]:
        return None
    replacement = type(table)(*table)
    replacement[_DESCRIPTIONS] = [None] * 3
    sertype[0] = ctypes.addressof(replacement)
    return replacement


class DdsMiddleware:
    """A participant of a domain."""

    def __init__(self, network: Network) -> None:
        self.version = version_of("cyclonedds")
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        try:
            self._domain: Domain | None = Domain(network.domain, configuration(network))
            participant_qos = Qos(Policy.Userdata(graph.PARTICIPANT_DATA.encode()))
            self._participant: DomainParticipant | None = DomainParticipant(network.domain, qos=participant_qos)
        except DDSException as error:
            raise MiddlewareError(f"CycloneDDS does not start: {error}") from error
        self._topics: dict[str, DdsTopic] = {}
        self._type_tables: list[Any] = []
        self._network = network
        self._readers: list[bytes] = []
        self._writers: list[bytes] = []
        self._node_info_writer = self._writer(graph.topic(network.gid_bytes))
        self._publish_node_info()

    def _topic(self, topic: Topic) -> DdsTopic:
        if topic.name not in self._topics:
            dds_topic = DdsTopic(self._participant, topic.dds_topic, struct_type(topic))
            self._type_tables.append(hide_type_description(dds_topic))
            self._topics[topic.name] = dds_topic
        return self._topics[topic.name]

    def publisher(self, topic: Topic) -> DdsWriter:
        """Create a data writer for a topic."""
        writer = self._writer(topic)
        self._writers.append(writer.guid.bytes)
        self._publish_node_info()
        return DdsWriter(writer)

    def _writer(self, topic: Topic) -> DataWriter:
        qos = quality(topic.quality, topic.user_data, writes=True)
        return DataWriter(DdsPublisher(self._participant), self._topic(topic), qos=qos)

    def _publish_node_info(self) -> None:
        """Publish to other participants that all endpoints belong to one node."""
        if self._participant is not None:
            guid, network = self._participant.guid.bytes, self._network
            node_info = graph.entities_info(guid, network.node, self._readers, self._writers, network.gid_bytes)
            ddspy_write(self._node_info_writer._ref, padded(node_info))

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """Create a data reader for a topic; return a function that returns the number of matched writers."""
        qos = quality(topic.quality, topic.user_data, writes=False)
        remote_only = Qos(Policy.IgnoreLocal.Participant, base=qos)
        reader = DataReader(DdsSubscriber(self._participant), self._topic(topic), qos=remote_only)
        self._readers.append(reader.guid.bytes)
        self._publish_node_info()
        thread = threading.Thread(target=self._read_samples, args=(reader, deliver), daemon=True)
        thread.start()
        self._threads.append(thread)
        return lambda: len(reader.get_matched_publications())

    def other_types(self, topic: Topic) -> set[str]:
        """Return the DDS type names that discovered endpoints of the topic have instead of its type in `topic`."""
        own_type = topic.dds_types[topic.type]
        return {
            endpoint.type_name
            for kind in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
            for endpoint in BuiltinDataReader(self._participant, kind).read(_MAX_ENDPOINTS)
            if endpoint.topic_name == topic.dds_topic and endpoint.type_name != own_type
        }

    def _read_samples(self, reader: DataReader, deliver: Deliver) -> None:
        wait_set = WaitSet(self._participant)
        wait_set.attach(ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any))
        while not self._closing.is_set():
            wait_set.wait(_WAIT_NS)
            while True:
                samples = ddspy_take(reader._ref, _ANY_STATE, _BATCH)
                at_ns = time.time_ns()
                if isinstance(samples, int) or not samples:
                    break
                for data, info in samples:
                    if info.valid_data:
                        deliver(unpadded(data), at_ns)

    def close(self) -> None:
        """Stop the readers and delete the participant."""
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._topics.clear()
        self._participant = self._domain = None


class DdsWriter:
    """A data writer."""

    def __init__(self, writer: DataWriter) -> None:
        self._writer = writer

    def write(self, data: bytes) -> bool:
        """Write a sample; return True if CycloneDDS accepted it."""
        return bool(ddspy_write(self._writer._ref, padded(data)) >= 0)

    def matched(self) -> int:
        """Return the number of matched readers."""
        return len(self._writer.get_matched_subscriptions())

    def drain(self, limit_s: float) -> None:
        """Wait until all samples are acknowledged, at most for this time."""
        # The public `wait_for_acks` of the binding raises an AttributeError after a timeout (11.0, pub.py).
        self._writer._wait_for_acks(self._writer._ref, int(limit_s * 1e9))
