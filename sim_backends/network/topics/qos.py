"""Quality of service of publish-subscribe by the names that ROS 2 has for it, and the timing of the protocol."""

from dataclasses import dataclass
from typing import Final, Literal

from fieldkit.core.errors import ConfigurationError

MS: Final = 1_000_000
SECOND: Final = 1000 * MS


@dataclass(frozen=True, slots=True)
class Qos:
    """What a flow is promised; durability is always volatile. The defaults are those of ROS 2.

    Attributes:
        reliability: `reliable`, or `best_effort`.
        history: `keep_last` samples up to `depth`, or `keep_all`: then the writer blocks while too much of them is
            unacknowledged.
        depth: How many samples `keep_last` keeps, those that are not acknowledged included.
        max_blocking_ns: How long a sample waits for a blocked writer before it is dropped; None is for ever, as
            ROS 2 has it on CycloneDDS.
    """

    reliability: Literal["reliable", "best_effort"] = "reliable"
    history: Literal["keep_last", "keep_all"] = "keep_last"
    depth: int = 10
    max_blocking_ns: int | None = None

    def __post_init__(self) -> None:
        """Check what types do not.

        Raises:
            ConfigurationError: The depth is below 1, a time is below 0, or a word is none of its own.
        """
        if self.reliability not in {"reliable", "best_effort"} or self.history not in {"keep_last", "keep_all"}:
            raise ConfigurationError(
                f"a quality of service cannot be {self.reliability}, {self.history}",
                remedy="reliability is reliable or best_effort, history is keep_last or keep_all",
            )
        if self.depth < 1 or (self.max_blocking_ns is not None and self.max_blocking_ns < 0):
            raise ConfigurationError(
                f"a history of {self.depth} samples and a blocking time of {self.max_blocking_ns} ns cannot be",
                remedy="the depth is 1 or more, the time 0 or more",
            )


@dataclass(frozen=True, slots=True)
class TopicFlow:
    """A topic from one publisher to one subscriber.

    Attributes:
        publisher: Agent with the writer.
        subscriber: Agent with the reader.
        qos: Of both.
        topic: Name of the topic as ROS has it; its length is that of what the discovery tells.
        type_name: Name of its type, as DDS has it, likewise.
    """

    publisher: str
    subscriber: str
    qos: Qos = Qos()
    topic: str = "rt/scan"
    type_name: str = "sensor_msgs::msg::dds_::LaserScan_"


@dataclass(frozen=True, slots=True)
class RtpsTiming:
    """Times and sizes of the protocol. The defaults are CycloneDDS's (`defconfig.c` of its main branch in 2026).

    Attributes:
        fragment_bytes: What a sample is cut into (`FragmentSize`); a whole multiple goes into one message.
        message_bytes: The most that a message of new data holds (`MaxMessageSize`).
        answer_bytes: The most that a message of repeated data holds (`MaxRexmitMessageSize`).
        heartbeat_ns: From the last write to a heartbeat of its own, and between such (`HeartbeatInterval`).
        first_heartbeat_ns: From finding a reader to the first heartbeat.
        heartbeat_min_ns: The least of that, while much is unacknowledged.
        heartbeat_max_ns: The most, when nobody answers.
        heartbeat_ask_ns: The least between heartbeats that ask for an answer while much is unacknowledged.
        heartbeat_response_ns: From a heartbeat to what answers it (Fast DDS 5 ms).
        nack_delay_ns: The least between two requests for the same (`NackDelay`).
        ack_delay_ns: The least between two acknowledgements of the same (`AckDelay`).
        nack_repeat_ns: From a request to the next when no heartbeat comes (`AutoReschedNackDelay`).
        begin_ns: From finding a writer to the message by which a reader begins (`PreEmptiveAckDelay`).
        begin_repeat_ns: From that to the next.
        low_bytes: Unacknowledged data below which a blocked writer goes on (`WhcLow`).
        high_bytes: Above which it blocks at first (`WhcHighInit`).
        most_high_bytes: To what the latter grows while nothing is lost (`WhcHigh`).
    """

    fragment_bytes: int = 1344
    message_bytes: int = 14_720
    answer_bytes: int = 1456
    heartbeat_ns: int = 100 * MS
    first_heartbeat_ns: int = MS
    heartbeat_min_ns: int = 20 * MS
    heartbeat_max_ns: int = 8 * SECOND
    heartbeat_ask_ns: int = 5 * MS
    heartbeat_response_ns: int = 0
    nack_delay_ns: int = 100 * MS
    ack_delay_ns: int = 10 * MS
    nack_repeat_ns: int = 3 * SECOND
    begin_ns: int = 10 * MS
    begin_repeat_ns: int = SECOND
    low_bytes: int = 1024
    high_bytes: int = 30_720
    most_high_bytes: int = 512_000
