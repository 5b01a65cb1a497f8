"""DDS by CycloneDDS' Python binding, which its package calls `cyclonedds`. Its only importer.

Samples go through as bytes: the binding writes and takes serialized data (`_clayer`), in 2 us where its own
serializing takes 30 us and more. The library wants to know a type all the same, so it is built member by member;
others are told its name alone.
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

from fieldkit.agent import graph
from fieldkit.agent.middleware import Deliver, MiddlewareError, Network, Quality, Topic, version_of

BLOCKS_NS = 1_000_000_000
"""How long a write may block where a reliable reader lags behind, with all samples kept; ROS 2 waits without end."""

_ANY = SampleState.Any | ViewState.Any | InstanceState.Any
_AT_ONCE = 256
_MOST_ENDS = 4096
_OPERATIONS = 14
_TELLING = slice(8, 11)
"""Where `type_id`, `type_map` and `type_info` stand among the operations of a type."""
_WAKES_NS = 100_000_000
_UNLIMITED = -1

_LANGUAGE: Mapping[str, Any] = {
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
    """Start a participant; see `middleware.start`."""
    return DdsMiddleware(network)


def configuration(network: Network) -> str:
    """Return CycloneDDS' configuration: one interface, ports that are known, and how others are found."""
    multicast = "true" if network.discovery == "multicast" else "false"
    wanted = {
        "General/AllowMulticast": multicast,
        # Ports by RTPS' own rule, so that peers without multicast, and captures, know them.
        "Discovery/ParticipantIndex": "auto",
        **network.settings,
    }
    peers = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in network.peers)
    fixed = {
        "General": f"<Interfaces><NetworkInterface address={quoteattr(network.address)}/></Interfaces>",
        "Discovery": f"<Peers>{peers}</Peers>" if peers else "",
    }
    return f"<CycloneDDS><Domain>{_elements(wanted, fixed)}</Domain></CycloneDDS>"


def _elements(wanted: Mapping[str, str], fixed: Mapping[str, str]) -> str:
    """Return settings by their path as nested elements; `@` begins the name of an attribute."""
    inside: dict[str, dict[str, str]] = {name: {} for name in fixed}
    leaves = []
    for path, value in wanted.items():
        name, _, rest = path.partition("/")
        own, _, attribute = name.partition("@")
        if rest:
            inside.setdefault(name, {})[rest] = value
        elif attribute:
            leaves.append(f"<{own} {attribute}={quoteattr(value)}/>")
        else:
            leaves.append(f"<{name}>{escape(value)}</{name}>")
    nested = (f"<{name}>{fixed.get(name, '')}{_elements(rest, {})}</{name}>" for name, rest in inside.items())
    return "".join([*leaves, *nested])


def quality(wanted: Quality, user_data: str, *, writes: bool) -> Qos:
    """Return a quality of service in DDS' terms, of a writer or a reader."""
    policies = [Policy.DataRepresentation(use_cdrv0_representation=True)]
    if wanted.reliability == "reliable":
        policies.append(Policy.Reliability.Reliable(BLOCKS_NS))
    elif wanted.reliability == "best_effort":
        policies.append(Policy.Reliability.BestEffort)
    if wanted.history == "keep_all":
        policies.append(Policy.History.KeepAll)
    elif wanted.history == "keep_last" and wanted.depth:
        policies.append(Policy.History.KeepLast(wanted.depth))
    policies += _durability(wanted, writes=writes)
    if wanted.deadline_ns is not None:
        policies.append(Policy.Deadline(wanted.deadline_ns))
    if wanted.lifespan_ns is not None and writes:
        policies.append(Policy.Lifespan(wanted.lifespan_ns))
    if user_data:
        policies.append(Policy.Userdata(user_data.encode()))
    return Qos(*policies)


def _durability(wanted: Quality, *, writes: bool) -> list[Any]:
    """Return the policies of durability; what a writer keeps for late readers DDS says apart, and is 1 otherwise."""
    if wanted.durability != "transient_local":
        return [Policy.Durability.Volatile] if wanted.durability == "volatile" else []
    kept = Policy.History.KeepAll if wanted.history == "keep_all" else Policy.History.KeepLast(wanted.depth or 1)
    service = [Policy.DurabilityService(0, kept, *[_UNLIMITED] * 3)] if writes else []
    return [Policy.Durability.TransientLocal, *service]


def struct_type(topic: Topic) -> type:
    """Return the topic's type as the binding's own, member by member."""
    return _make(topic.type, topic, {})


def _make(name: str, topic: Topic, made: dict[str, type]) -> type:
    if name in made:
        return made[name]
    annotations: dict[str, Any] = {}
    for member, kind, count in topic.members[name]:
        one = _make(kind, topic, made) if kind in topic.members else _LANGUAGE[kind]
        if count is None:
            annotations[member] = one
        elif count > 0:
            annotations[member] = types.array[one, count]
        else:
            annotations[member] = types.sequence[one, -count] if count else types.sequence[one]
    # The binding turns points into the colons of IDL.
    typename = topic.dds_types[name].replace("::", ".")
    made[name] = make_idl_struct(name.rpartition("/")[2], typename, annotations)
    return made[name]


def padded(data: bytes) -> bytes:
    """Return a sample as it goes on the wire: filled to words of 4 bytes, the number of bytes added in its header.

    RTPS 2.5, section 10.2 (the two lowest bits of the encapsulation's options, of XTypes 1.3, section 7.6.3.1.2).
    """
    added = -len(data) % 4
    return data if not added else data[:3] + bytes([data[3] & ~3 | added]) + data[4:] + bytes(added)


def unpadded(data: bytes) -> bytes:
    """Return a sample as it was before `padded`."""
    added = data[3] & 3 if len(data) > 3 else 0
    return data if not added else data[:3] + bytes([data[3] & ~3]) + data[4:-added]


def keep_type_untold(topic: DdsTopic) -> Any:  # noqa: ANN401 (of ctypes)
    """Have discovery tell a topic's type by its name alone; before any end of it is made.

    CycloneDDS 11.0 cannot read descriptions of types by Fast DDS 3, which ROS 2 Kilted has, and where both ends tell
    one, those that do not agree never match. The binding has no option for it, so the three functions that give the
    description are taken out of the type's table (`struct ddsi_sertype_ops`), if that looks as it must.

    Returns:
        The table, which must live as long as the topic; None where nothing was changed.
    """
    library = loaded_library()
    sertype = ctypes.POINTER(ctypes.c_void_p)()
    if library.dds_get_entity_sertype(topic._ref, ctypes.byref(sertype)) != 0:
        return None
    table = ctypes.cast(sertype[0], ctypes.POINTER(ctypes.c_void_p * _OPERATIONS))[0]
    version = ctypes.cast(library.ddsi_sertype_v0, ctypes.c_void_p).value
    if table[0] != version or table[1] is not None or None in table[_TELLING]:
        return None
    own = type(table)(*table)
    own[_TELLING] = [None] * 3
    sertype[0] = ctypes.addressof(own)
    return own


class DdsMiddleware:
    """A participant of a domain."""

    def __init__(self, network: Network) -> None:
        self.version = version_of("cyclonedds")
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        try:
            self._domain: Domain | None = Domain(network.domain, configuration(network))
            told = Qos(Policy.Userdata(graph.PARTICIPANT_DATA.encode()))
            self._participant: DomainParticipant | None = DomainParticipant(network.domain, qos=told)
        except DDSException as error:
            raise MiddlewareError(f"CycloneDDS does not start: {error}") from error
        self._topics: dict[str, DdsTopic] = {}
        self._untold: list[Any] = []
        self._network = network
        self._readers: list[bytes] = []
        self._writers: list[bytes] = []
        self._nodes = self._writer(graph.topic(network.gid_bytes))
        self._tell_nodes()

    def _topic(self, topic: Topic) -> DdsTopic:
        if topic.name not in self._topics:
            made = DdsTopic(self._participant, topic.dds_topic, struct_type(topic))
            self._untold.append(keep_type_untold(made))
            self._topics[topic.name] = made
        return self._topics[topic.name]

    def publisher(self, topic: Topic) -> DdsWriter:
        """See `Middleware.publisher`."""
        made = self._writer(topic)
        self._writers.append(made.guid.bytes)
        self._tell_nodes()
        return DdsWriter(made)

    def _writer(self, topic: Topic) -> DataWriter:
        offered = quality(topic.quality, topic.user_data, writes=True)
        return DataWriter(DdsPublisher(self._participant), self._topic(topic), qos=offered)

    def _tell_nodes(self) -> None:
        """Tell other participants which node all ends belong to."""
        if self._participant is not None:
            guid, network = self._participant.guid.bytes, self._network
            told = graph.entities_info(guid, network.node, self._readers, self._writers, network.gid_bytes)
            ddspy_write(self._nodes._ref, padded(told))

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """See `Middleware.subscribe`."""
        offered = quality(topic.quality, topic.user_data, writes=False)
        wanted = Qos(Policy.IgnoreLocal.Participant, base=offered)
        reader = DataReader(DdsSubscriber(self._participant), self._topic(topic), qos=wanted)
        self._readers.append(reader.guid.bytes)
        self._tell_nodes()
        thread = threading.Thread(target=self._take, args=(reader, deliver), daemon=True)
        thread.start()
        self._threads.append(thread)
        return lambda: len(reader.get_matched_publications())

    def other_types(self, topic: Topic) -> set[str]:
        """See `Middleware.other_types`."""
        own = topic.dds_types[topic.type]
        return {
            end.type_name
            for kind in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
            for end in BuiltinDataReader(self._participant, kind).read(_MOST_ENDS)
            if end.topic_name == topic.dds_topic and end.type_name != own
        }

    def _take(self, reader: DataReader, deliver: Deliver) -> None:
        waiting = WaitSet(self._participant)
        waiting.attach(ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any))
        while not self._closing.is_set():
            waiting.wait(_WAKES_NS)
            while True:
                found = ddspy_take(reader._ref, _ANY, _AT_ONCE)
                at_ns = time.time_ns()
                if isinstance(found, int) or not found:
                    break
                for data, info in found:
                    if info.valid_data:
                        deliver(unpadded(data), at_ns)

    def close(self) -> None:
        """See `Middleware.close`."""
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
        """See `Publisher.write`."""
        return bool(ddspy_write(self._writer._ref, padded(data)) >= 0)

    def matched(self) -> int:
        """See `Publisher.matched`."""
        return len(self._writer.get_matched_subscriptions())

    def drain(self, limit_s: float) -> None:
        """See `Publisher.drain`."""
        # The binding's own `wait_for_acks` fails by an AttributeError where the time is up (11.0, pub.py).
        self._writer._wait_for_acks(self._writer._ref, int(limit_s * 1e9))
