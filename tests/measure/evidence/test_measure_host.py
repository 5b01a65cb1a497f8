from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.evidence import host
from fieldkit.measure.evidence.host import Counters

# Output of a Linux 6.1 host, without other groups.
STATE = """\
==> /proc/net/dev <==
Udp: RcvbufErrors
Udp: 99
==> /proc/net/snmp <==
Ip: Forwarding DefaultTTL InReceives InHdrErrors ReasmTimeout ReasmReqds ReasmOKs ReasmFails FragOKs
Ip: 1 64 88417 0 2 215 36 {reassembly} 0
Tcp: RtoAlgorithm RtoMin RtoMax MaxConn ActiveOpens
Tcp: 1 200 120000 -1 1372
Udp: InDatagrams NoPorts InErrors OutDatagrams RcvbufErrors SndbufErrors InCsumErrors IgnoredMulti MemErrors
Udp: 21 0 4 20 {buffer} 0 0 0 0
UdpLite: InDatagrams NoPorts InErrors OutDatagrams RcvbufErrors SndbufErrors InCsumErrors IgnoredMulti MemErrors
UdpLite: 0 0 0 0 77 0 0 0 0
==> /proc/uptime <==
1.0 2.0
"""


def test_counters_are_read_from_their_section_and_group() -> None:
    counters = host.parse_counters(STATE.format(reassembly=3, buffer=17))
    assert (counters.udp_buffer_errors, counters.reassembly_failures) == (17, 3)


def test_the_difference_of_counters_is_after_minus_before() -> None:
    before, after = (host.parse_counters(STATE.format(reassembly=n, buffer=10 * n)) for n in (3, 5))
    change = host.increments(before, after)
    assert (change.udp_buffer_errors, change.reassembly_failures) == (20, 2)


def test_a_counter_that_is_missing_or_decreased_has_no_difference() -> None:
    assert host.increments(Counters(None, 5), Counters(3, 4)) == Counters(None, None)


@pytest.mark.parametrize(
    "text",
    ["", "==> /proc/net/snmp <==\n", "Ip: ReasmFails\nIp: 1\n", "==> /proc/net/snmp <==\nIp: ReasmFails\nIp: x\n"],
)
def test_a_state_without_counters_has_none(text: str) -> None:
    assert host.parse_counters(text) == Counters(None, None)


@given(st.text(), st.text(st.sampled_from("= \n/:UdpIp019RcvbufErrors"), max_size=80))
def test_any_text_raises_no_error(text: str, snmp: str) -> None:
    host.parse_counters(text)
    host.parse_counters("==> /proc/net/snmp <==\n" + snmp)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("==> /proc/sys/net/ipv4/tcp_congestion_control <==\ncubic\n==> ip -s link <==\n", "cubic"),
        ("==> /proc/sys/net/ipv4/tcp_congestion_control <==\n", None),
        ("==> /proc/sys/net/ipv4/tcp_congestion_control <==\nbbr\x1b[31m\n", None),
        ("==> /proc/sys/net/ipv4/tcp_congestion_control <==\ncat: permission denied\n", None),
        ("==> /proc/net/snmp <==\ncubic\n", None),
    ],
)
def test_the_congestion_control_of_a_robot_is_parsed(text: str, name: str | None, tmp_path: Path) -> None:
    file = tmp_path / "sender-before.txt"
    file.write_text(text, encoding="utf-8")
    assert host.congestion_control(file) == name
