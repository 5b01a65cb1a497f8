"""Settings of middlewares that their developers or ROS 2 recommend as a first step on a lossy radio.

Comments contain the default and the source of each setting. Kernel settings (`net.core.rmem_max`,
`net.ipv4.ipfrag_time`) are not included, because they apply to the whole machine, need root and remain after a trial;
see docs/studies/middleware.md.
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
"""Faster retransmission requests of readers (Internal/NackDelay, 100 ms) and a larger writer cache
(Internal/Watermarks/WhcHigh, 500 kB) were also measured: see docs/studies/middleware.md."""

_ZENOH: Final = {
    # Default `drop`: a sample is dropped if the queue has no space for its fragments for 50 ms, which affects all
    # large samples on a radio. `block_first` waits with the first sample, and drops samples that follow in the
    # meantime (ROSCon 2025 workshop on rmw_zenoh, exercise 7; Zenoh, DEFAULT_CONFIG.json5, qos/publication).
    # `express` does not wait for more samples to fill a batch.
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
"""Datagrams of one packet (`UDPv4?max_msg_size=1400B`) and later answers were measured, too: see
docs/studies/middleware.md."""

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
