"""Quality of service of publish-subscribe with the names of ROS 2, and the timing of the protocol."""

from dataclasses import dataclass
from typing import Final, Literal

from fieldkit.core.errors import ConfigurationError

MS: Final = 1_000_000
SECOND: Final = 1000 * MS


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of a flow; durability is always volatile. The defaults are the same as in ROS 2.

    Attributes:
        reliability: `reliable`, or `best_effort`.
        history: `keep_last` samples up to `depth`, or `keep_all`: then the writer blocks while too many of them are
            unacknowledged.
        depth: Number of samples that `keep_last` stores, including unacknowledged ones.
        max_blocking_ns: Time for which a sample waits for a blocked writer before it is dropped; None means without
            limit, as in ROS 2 on CycloneDDS.
    """

    reliability: Literal["reliable", "best_effort"] = "reliable"
    history: Literal["keep_last", "keep_all"] = "keep_last"
    depth: int = 10
    max_blocking_ns: int | None = None

    def __post_init__(self) -> None:
        """Check values beyond their types.

        Raises:
            ConfigurationError: The depth is below 1, a time is below 0, or a policy name is unknown.
        """
        if self.reliability not in {"reliable", "best_effort"} or self.history not in {"keep_last", "keep_all"}:
            raise ConfigurationError(
                f"the quality of service {self.reliability}, {self.history} does not exist",
                remedy="use reliable or best_effort as reliability, and keep_last or keep_all as history",
            )
        if self.depth < 1 or (self.max_blocking_ns is not None and self.max_blocking_ns < 0):
            raise ConfigurationError(
                f"a depth of {self.depth} samples with a blocking time of {self.max_blocking_ns} ns is invalid",
                remedy="use a depth of at least 1 and a time of at least 0",
            )


@dataclass(frozen=True, slots=True)
class TopicFlow:
    """A topic from one publisher to one subscriber.

    Attributes:
        publisher: Agent with the writer.
        subscriber: Agent with the reader.
        qos: Quality of service of writer and reader.
        topic: Name of the topic in ROS; its length affects the size of discovery messages.
        type_name: DDS name of its type; its length also affects the size of discovery messages.
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
        fragment_bytes: Size of a sample's fragments (`FragmentSize`); a message contains an integer number of them.
        message_bytes: Maximum size of a message of new data (`MaxMessageSize`).
        retransmit_bytes: Maximum size of a message of retransmitted data (`MaxRexmitMessageSize`).
        heartbeat_ns: Time from the last write to a separate heartbeat, and interval of separate heartbeats
            (`HeartbeatInterval`).
        first_heartbeat_ns: Time from matching a reader to the first heartbeat.
        heartbeat_min_ns: Minimum heartbeat interval, used while much data is unacknowledged.
        heartbeat_max_ns: Upper limit of the heartbeat interval, which doubles while the reader does not respond.
        ack_request_min_ns: Minimum interval of heartbeats that require a response while much data is unacknowledged.
        heartbeat_response_ns: Time from a heartbeat to its response (Fast DDS 5 ms).
        nack_delay_ns: Minimum interval of two requests for the same data (`NackDelay`).
        ack_delay_ns: Minimum interval of two acknowledgements of the same data (`AckDelay`).
        nack_repeat_ns: Time from a request to the next if no heartbeat arrives (`AutoReschedNackDelay`).
        first_acknack_ns: Time from matching a writer to the reader's first ACKNACK (`PreEmptiveAckDelay`).
        first_acknack_repeat_ns: Initial interval at which the first ACKNACK is repeated.
        low_bytes: Low watermark: unacknowledged data up to which a blocked writer resumes (`WhcLow`).
        high_bytes: Initial high watermark, above which a writer blocks (`WhcHighInit`).
        max_high_bytes: Maximum high watermark, reached while nothing is lost (`WhcHigh`).
    """

    fragment_bytes: int = 1344
    message_bytes: int = 14_720
    retransmit_bytes: int = 1456
    heartbeat_ns: int = 100 * MS
    first_heartbeat_ns: int = MS
    heartbeat_min_ns: int = 20 * MS
    heartbeat_max_ns: int = 8 * SECOND
    ack_request_min_ns: int = 5 * MS
    heartbeat_response_ns: int = 0
    nack_delay_ns: int = 100 * MS
    ack_delay_ns: int = 10 * MS
    nack_repeat_ns: int = 3 * SECOND
    first_acknack_ns: int = 10 * MS
    first_acknack_repeat_ns: int = SECOND
    low_bytes: int = 1024
    high_bytes: int = 30_720
    max_high_bytes: int = 512_000
