"""Settings of middlewares for a lossy radio, as those who make them, or ROS 2, advise; the first thing to try.

Each stands beside its default and its source. Settings of the kernel (`net.core.rmem_max`, `net.ipv4.ipfrag_time`)
are the machine's, need root and outlive a trial, so they are not among them; see docs/studies/middleware.md.
"""

import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

_DDS: Final = {
    # 14720 B: ten IP packets, of which one that is lost takes the other nine with it. So a datagram is a packet, and
    # holds a fragment (1344 B) with its headers. docs.ros.org, How-To-Guides/DDS-tuning, on IP fragments; defaults:
    # CycloneDDS, docs/manual/config/config_file_reference.rst.
    "General/MaxMessageSize": "1400 B",
    "General/FragmentSize": "1300 B",
}
"""A reader that asks sooner for what is missing (Internal/NackDelay, 100 ms) and a writer that waits later
(Internal/Watermarks/WhcHigh, 500 kB) were tried, too: see docs/studies/middleware.md."""

_ZENOH: Final = {
    # `drop`: a sample whose fragments find no place in the queue for 50 ms is given up, which is every large one on a
    # radio. `block_first` waits with the first, and drops what comes meanwhile (ROSCon 2025 workshop on rmw_zenoh,
    # exercise 7; Zenoh, DEFAULT_CONFIG.json5, qos/publication). `express` does not wait for others to fill a batch.
    "qos/publication": json.dumps(
        [{"key_exprs": ["**"], "config": {"congestion_control": "block_first", "express": True}}]
    ),
}

_ZENOH_UDP: Final = {
    **_ZENOH,
    # 65535 B: one datagram of up to 45 IP packets, as above (DEFAULT_CONFIG.json5, transport/link/tx/batch_size).
    "transport/link/tx/batch_size": "1400",
}

_ROS1: Final = {
    # TCP keeps a small sample back until the one before is acknowledged (RFC 896) unless a subscriber asks for this
    # (wiki.ros.org, roscpp/Overview/Publishers and Subscribers, Transport Hints).
    "tcp_nodelay": "1",
}

_FAST_DDS: Final = {
    # By UDP a sample is in datagrams of 65500 B, up to 45 IP packets each, and what is missing is asked for every few
    # milliseconds. By TCP the radio is sent what it carries; discovery stays with UDP (fast-dds.docs.eprosima.com,
    # Use-cases, "Large Data mode": large samples over lossy networks).
    "FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA",
}
"""Datagrams of one packet (`UDPv4?max_msg_size=1400B`) and later answers were tried: docs/studies/middleware.md."""

_TUNED: Final[Mapping[tuple[str, str], Mapping[str, str]]] = MappingProxyType(
    {
        ("dds", "tcp"): _DDS,
        ("zenoh", "tcp"): _ZENOH,
        ("zenoh", "udp"): _ZENOH_UDP,
        ("ros1", "tcp"): _ROS1,
        ("ros2", "tcp"): _FAST_DDS,
    }
)


def tuned(over: str, transport: str) -> Mapping[str, str]:
    """Return settings by their path.

    Args:
        over: The middleware.
        transport: What carries Zenoh, `tcp` or `udp`; `tcp` for all others.
    """
    return _TUNED[over, transport]
