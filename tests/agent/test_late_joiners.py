"""Durability `transient_local`: a late subscription receives the last samples, as many as the depth."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fieldkit.ros.bridging.crossings import parse_qos
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers.paths import ROOT
from tests.helpers.two_hosts import TestHost, two_connected_hosts

WIRE_END = ROOT / "tests" / "ros" / "bridging" / "wire_end.py"
TYPE = "std_msgs/msg/String"
DEPTH = 2
LIMIT_S = "90"


@contextmanager
def running_endpoint(host: TestHost, verb: str, middleware_name: str, file: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a publisher or subscription while the body runs."""
    quality = parse_qos(f"transient_local,depth={DEPTH}")
    topic = topics.describe(standard_types(), "/map", TYPE, quality, domain=0, node=verb)
    network = {"address": host.address, "node": verb}
    arguments = (verb, middleware_name, json.dumps(network), json.dumps(topic), str(file))
    namespace_command = ("timeout", "-k", "10", LIMIT_S, "nsenter", "-t", str(host.pid), "-n")
    command = (*namespace_command, sys.executable, str(WIRE_END), *arguments)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.communicate()


@pytest.mark.emulated
@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_late_subscription_receives_the_last_samples(middleware_name: str, tmp_path: Path) -> None:
    store = standard_types().ros2
    published = [bytes(store.serialize_cdr(store.types[TYPE](text), TYPE)).hex() for text in ("one", "two", "three")]
    file = tmp_path / "samples"
    file.write_text("\n".join(published), encoding="ascii")
    with (
        two_connected_hosts() as (publishing, subscribing),
        running_endpoint(publishing, "say", middleware_name, file) as publisher,
    ):
        with running_endpoint(subscribing, "hear", middleware_name, file) as early_subscriber:
            assert early_subscriber.stdout is not None
            for line in early_subscriber.stdout:
                if line.strip() == published[-1]:
                    break
            assert publisher.stdout is not None
            assert publisher.stdout.readline() == "matched\n"
        # All samples have been published before this subscription starts.
        with running_endpoint(subscribing, "hear", middleware_name, file) as late_subscriber:
            assert late_subscriber.stdout is not None
            assert [late_subscriber.stdout.readline().strip() for _ in range(DEPTH)] == published[-DEPTH:]
