"""Keys of `radio.phy` in the medium: real packets of robots have a category by their DSCP, and wait for beacons."""

import os
import re
import statistics
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

import pytest

from benchmarks.namespaces import Namespace
from fieldkit.config.profiles import Radio
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.radio_options import RadioOptions

ADDRESSES = {"a": "10.9.0.1", "b": "10.9.0.2"}
# 900 packets of 1428 bytes need about 1.7 s at 6.5 Mbit/s. The program becomes ping, so that ping starts earlier.
BURST = """\
import os, socket, sys
udp = socket.socket(type=socket.SOCK_DGRAM)
for _ in range(900):
    udp.sendto(bytes(1400), ("10.9.0.2", 9))
os.execvp(sys.argv[1], sys.argv[1:])
"""


@contextmanager
def medium(
    phy: dict[str, object], *, relay: str | None = None, mode: str | None = None
) -> Iterator[dict[str, Namespace]]:
    radio = Radio.model_validate(
        {"interface": "wlan0", "standard": "802.11n 2.4 GHz", "tx_power_dbm": 17, "sensitivity_dbm": -82, "phy": phy}
    )
    with ExitStack() as stack:
        options = RadioOptions.model_validate({"fading": False} | ({} if mode is None else {"mode": mode}))
        client = stack.enter_context(MediumClient(options, seed=1))
        spaces = {name: stack.enter_context(Namespace()) for name in ADDRESSES}
        for name, space in spaces.items():
            fd = space.tun("wlan0", f"{ADDRESSES[name]}/24")
            client.attach(name, f"{ADDRESSES[name]}/24", radio, fd)
            os.close(fd)
        client.place({"a": (0.0, 0.0, 0.0), "b": (9.0, 0.0, 0.0)}, relay=relay)
        yield spaces


def ping_ms(space: Namespace, address: str, *arguments: str, command: Sequence[str] = ()) -> list[float]:
    """Return the round-trip times of a ping; `command` runs the command that its last arguments are."""
    output = space.run(*command, "ping", *arguments, address, timeout_s=30.0).stdout
    return [float(value) for value in re.findall(r"time=([\d.]+)", output)]


@pytest.mark.emulated
@pytest.mark.parametrize(("dscp", "is_first"), [(48, True), (0, False)])
def test_packets_with_a_voice_dscp_overtake_a_queue_of_others(dscp: int, is_first: bool) -> None:
    with medium({"access_categories": "linux"}, mode="ht20-mcs0-1ss-800ns") as spaces:
        ping_ms(spaces["a"], ADDRESSES["b"], "-c", "2", "-i", "0.05")
        (rtt_ms,) = ping_ms(
            spaces["a"], ADDRESSES["b"], "-c", "1", "-Q", str(dscp << 2), command=("python3", "-c", BURST)
        )
    assert (rtt_ms < 200) if is_first else (rtt_ms > 250)


@pytest.mark.emulated
def test_pings_to_a_robot_with_power_save_wait_for_the_beacon_and_pings_from_it_do_not() -> None:
    with medium({"power_save": True, "power_save_timeout": "20ms"}, relay="b") as spaces:
        slow_ms = ping_ms(spaces["b"], ADDRESSES["a"], "-c", "12", "-i", "0.23")
        fast_ms = ping_ms(spaces["a"], ADDRESSES["b"], "-c", "8", "-i", "0.23")
    assert len(slow_ms) == 12
    assert 20 < statistics.median(slow_ms) < 90
    assert statistics.median(fast_ms) < 15
