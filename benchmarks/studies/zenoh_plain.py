"""A plain pair of Zenoh sessions, the reference for the agent: `python zenoh_plain.py subscribe|publish JSON`.

It does not import fieldkit, so errors of fieldkit's adapter cannot affect it. Publisher and subscriber print a line
of JSON for each sample: its number and times in nanoseconds since 1970 UTC. The subscriber exits at the end of its
standard input.
"""

import json
import struct
import sys
import time
from typing import Any, Final

import zenoh

HEAD: Final = struct.Struct("<qq")
SETTLING_S: Final = 0.5
"""Wait from the discovery of the subscriber until the first sample, as in fieldkit's agent."""
DRAIN_S: Final = 2.0
"""Wait after the last sample, so that queued samples are sent before the session is closed."""


def subscribe(session: Any, request: dict[str, Any]) -> None:  # noqa: ANN401 (Zenoh declares no types)
    """Print each sample until standard input ends."""

    def print_sample(sample: Any) -> None:  # noqa: ANN401 (Zenoh declares no types)
        data = sample.payload.to_bytes()
        at_ns = time.time_ns()
        print(json.dumps([HEAD.unpack_from(data)[0], at_ns]), flush=True)

    declared = session.declare_subscriber(request["key"], print_sample)
    print("up", flush=True)
    sys.stdin.read()
    declared.undeclare()


def publish(session: Any, request: dict[str, Any]) -> None:  # noqa: ANN401 (Zenoh declares no types)
    """Publish samples at their times with congestion control DROP, as rmw_zenoh does except for KEEP_ALL."""
    publisher = session.declare_publisher(request["key"], congestion_control=zenoh.CongestionControl.DROP)
    while not publisher.matching_status.matching:
        time.sleep(0.01)
    time.sleep(SETTLING_S)
    started_s = time.monotonic()
    padding = bytes(request["bytes"] - HEAD.size)
    for number in range(request["samples"]):
        time.sleep(max(started_s + number / request["rate"] - time.monotonic(), 0.0))
        sent_ns = time.time_ns()
        publisher.put(HEAD.pack(number, sent_ns) + padding)
        print(json.dumps([number, sent_ns, time.time_ns()]), flush=True)
    time.sleep(DRAIN_S)


def main() -> None:
    """Open a session and run the publisher or the subscriber."""
    verb, request = sys.argv[1], json.loads(sys.argv[2])
    config = zenoh.Config()
    for path, value in request["config"].items():
        config.insert_json5(path, json.dumps(value))
    session: Any = zenoh.open(config)
    {"subscribe": subscribe, "publish": publish}[verb](session, request)
    session.close()


if __name__ == "__main__":
    main()
