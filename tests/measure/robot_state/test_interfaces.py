"""Indices of interfaces in the output of `ip -o link`, of iproute2 and busybox."""

from pathlib import Path

import pytest

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import interfaces, snapshots
from fieldkit.measure.robot_state.snapshots import SourceOutput

IPROUTE2 = """\
1: lo: <LOOPBACK,UP,LOWER_UP> mtu 65536 qdisc noqueue state UNKNOWN mode DEFAULT\\    link/loopback 00:00:00:00:00:00
3: wlan0: <NO-CARRIER,BROADCAST,MULTICAST,UP> mtu 1500 qdisc noqueue state DORMANT mode DORMANT group default
27: wwan0@if26: <BROADCAST,MULTICAST,UP,LOWER_UP> mtu 1500 qdisc noqueue state UP mode DEFAULT group default
28: mesh.7@wlan0: <BROADCAST,MULTICAST> mtu 1500 qdisc noop state DOWN mode DEFAULT group default
"""
BUSYBOX = """\
1: lo: <LOOPBACK,UP,LOWER_UP> mtu 65536 qdisc noqueue qlen 1000\\    link/loopback 00:00:00:00:00:00
2: usb0: <BROADCAST,MULTICAST,UP,LOWER_UP> mtu 1500 qdisc fq_codel qlen 1000\\    link/ether 02:11:22:33:44:55
"""


@pytest.mark.parametrize(
    ("text", "indices"),
    [
        (IPROUTE2, {"lo": 1, "wlan0": 3, "wwan0": 27, "mesh.7": 28}),
        (BUSYBOX, {"lo": 1, "usb0": 2}),
        ("ip: RTNETLINK answers: Operation not permitted\n", {}),
        ("0: lo: <UP>\n12345678901: wlan0: <UP>\n5: a name: <UP>\n6: longer_than_fifteen_: <UP>\n 7: x: <UP>\n", {}),
    ],
    ids=["iproute2", "busybox", "error", "hostile"],
)
def test_indices_are_read(text: str, indices: dict[str, int]) -> None:
    assert interfaces.parse({"interfaces": SourceOutput(text, 0)}) == indices
    assert interfaces.parse({"interfaces": SourceOutput(text, 1)}) == {}


def test_an_interface_that_was_replaced_during_the_attempt_has_no_index(tmp_path: Path) -> None:
    outputs = {
        snapshots.before_file(Role.SENDER): "1: lo: <UP>\n2: wlan0: <UP>\n3: wwan0: <UP>",
        snapshots.after_file(Role.SENDER): "1: lo: <UP>\n2: wlan0: <UP>\n9: wwan0: <UP>",
    }
    for file, text in outputs.items():
        lines = "".join(f" {line}\n" for line in (*text.split("\n"), "code 0"))
        (tmp_path / file).write_text(f"==> interfaces <==\n{lines}", encoding="utf-8")
    evidence = AttemptEvidence(tmp_path)
    assert interfaces.read_indices(evidence, Role.SENDER) == {"lo": 1, "wlan0": 2}
    assert interfaces.read_indices(evidence, Role.RECEIVER) == {}, "the file is missing"
