"""Settings that the developers of a middleware or the documentation of ROS 2 recommend for a lossy radio.

The comments state the default and the source of each setting. Kernel settings (`net.core.rmem_max`,
`net.ipv4.ipfrag_time`) are not included, because they apply to the whole machine, need root privileges and remain
after a trial. The results are in docs/studies/middleware.md.
"""

import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

_DDS: Final = {
    # Default 14720 B: a datagram of ten IP packets is lost if one of them is lost. With these settings, a datagram is
    # one packet, with one fragment (default 1344 B) and its headers. docs.ros.org, How-To-Guides/DDS-tuning, on IP
    # fragments; defaults: CycloneDDS, docs/manual/config/config_file_reference.rst.
    "General/MaxMessageSize": "1400 B",
    "General/FragmentSize": "1300 B",
}
"""Faster retransmission requests of readers (Internal/NackDelay, 10 or 30 ms instead of 100 ms) and a larger writer
cache (Internal/Watermarks/WhcHigh, 4 MB instead of 500 kB) are not included: with them, more images were lost."""

_ZENOH: Final = {
    # Default `drop`: a sample is dropped if the queue has no space for its fragments for 50 ms, which affects all
    # large samples on a radio. With `block_first` the first sample that does not fit waits for space in the queue,
    # and samples that follow in the meantime are dropped (ROSCon 2025 workshop on rmw_zenoh, exercise 7; Zenoh,
    # DEFAULT_CONFIG.json5, qos/publication). With `express` a sample is sent without waiting for others that fill its
    # batch.
    "qos/publication": json.dumps(
        [{"key_exprs": ["**"], "config": {"congestion_control": "block_first", "express": True}}]
    ),
}

_ZENOH_UDP: Final = {
    **_ZENOH,
    # Default 65535 B: a datagram of up to 45 IP packets (DEFAULT_CONFIG.json5, transport/link/tx/batch_size).
    "transport/link/tx/batch_size": "1400",
}

_ROS1: Final = {
    # By default TCP delays a small sample until the previous one is acknowledged (RFC 896), unless a subscriber
    # requests this setting (wiki.ros.org, roscpp/Overview/Publishers and Subscribers, Transport Hints).
    "tcp_nodelay": "1",
}

_FAST_DDS: Final = {
    # By default samples are sent over UDP in datagrams of 65500 B, up to 45 IP packets each, and missing ones are
    # requested every few milliseconds. TCP adapts the rate to the radio; discovery still uses UDP
    # (fast-dds.docs.eprosima.com, Use-cases, "Large Data mode": large samples over lossy networks).
    "FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA",
}
"""Datagrams of one packet (`UDPv4?max_msg_size=1400B`) and longer response delays (`nack_response_delay` and
`heartbeat_response_delay` of 100 ms) are not included: with them, half or more of the images were lost."""

_TUNED: Final[Mapping[tuple[str, str], Mapping[str, str]]] = MappingProxyType(
    {
        ("dds", "tcp"): _DDS,
        ("zenoh", "tcp"): _ZENOH,
        ("zenoh", "udp"): _ZENOH_UDP,
        ("ros1", "tcp"): _ROS1,
        ("ros2", "tcp"): _FAST_DDS,
    }
)


def recommended_settings(over: str, transport: str) -> Mapping[str, str]:
    """Return the recommended settings of a middleware by their path.

    Args:
        over: The middleware.
        transport: Transport of Zenoh, `tcp` or `udp`; `tcp` for all others.
    """
    return _TUNED[over, transport]
