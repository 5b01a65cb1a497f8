"""Record the rates that minstrel_ht of Linux selects: `python -m benchmarks.kernel_minstrel TRACE`, as root.

The program runs in the virtual machine of `minstrel_vs_kernel`, with two radios of mac80211_hwsim in an ad hoc cell.
One radio sends a frame to the other at fixed intervals. The program is their medium: for each try of a frame it reads
the probability of an error from the trace. It prints a line for each frame: time in microseconds, the chain that the
kernel selected (stages `rate:tries:flags`), and the number of tries, with `+` if the frame was received.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any, Final

from benchmarks.experiment_packets import PacketSender, interface_address
from sim_backends.emulated.linux_wifi.hwsim_messages import (
    RATE_MCS,
    RATE_SHORT_GUARD_INTERVAL,
    RateStage,
    SentFrame,
    decode_event,
    encode_reception,
    encode_status,
)
from sim_backends.emulated.linux_wifi.hwsim_socket import open_registered
from sim_backends.emulated.linux_wifi.netlink import NLMSG_ERROR, FamilySocket
from sim_backends.emulated.linux_wifi.radios import HwsimRadio, find_radios

MAX_TRIES: Final = 7  # of a frame
SIGNAL_DBM: Final = -50
_DATA: Final = 0x08  # type of data frames in the field frame control
_JOIN_S: Final = 60.0  # time limit for joining the cell
_POLL_S: Final = 0.5  # interval between checks whether the radios have joined
_IDLE_S: Final = 0.0002  # pause while no frame is due
_CELL: Final = ("ibss", "join", "fieldkit", "2412", "HT20", "fixed-freq", "02:66:69:65:6c:64")


def is_received(trace: dict[str, Any], frame: int, attempt: int, mode: str | None) -> bool:
    """Return True if a try succeeds, never with 802.11b (None). The random draw depends on frame and attempt only."""
    if mode is None:
        return False
    error: float = trace["errors"][mode][trace["levels"][frame]]
    return Random(frame * 16 + attempt).random() >= error


def mode_name(stage: RateStage) -> str | None:
    """Return MCS and guard interval of a stage, `15 400`; None for 802.11b, which fieldkit does not have."""
    if not stage.flags & RATE_MCS:
        return None
    return f"{stage.index} {400 if stage.flags & RATE_SHORT_GUARD_INTERVAL else 800}"


def tries_of(trace: dict[str, Any], frame: int, stages: Sequence[RateStage]) -> tuple[list[int], bool]:
    """Return the number of tries in each stage of a frame's chain, and True if the last try succeeded."""
    tries: list[int] = []
    for stage in stages:
        tries.append(0)
        while tries[-1] < stage.tries and sum(tries) < MAX_TRIES:
            tries[-1] += 1
            if is_received(trace, frame, sum(tries), mode_name(stage)):
                return tries, True
    return tries, False


class Cell:
    """Two radios and their medium.

    Args:
        kernel: The registered socket.
        radios: The radios; the first one sends.
    """

    def __init__(self, kernel: FamilySocket, radios: list[HwsimRadio]) -> None:
        self._kernel = kernel
        self._addresses = [bytes.fromhex(radio.address.replace(":", "")) for radio in radios]
        self._sent: SentFrame | None = None

    def poll(self) -> SentFrame | None:
        """Forward all frames except unicast data frames of the first radio.

        Returns:
            A unicast data frame of the first radio, or None if there is none.
        """
        for message in self._kernel.receive():
            event = None if message.type == NLMSG_ERROR else decode_event(message.payload)
            if not isinstance(event, SentFrame):
                continue
            if event.frame[0] & 0x0C == _DATA and not event.is_group and event.radio == self._addresses[0]:
                return event
            other = self._addresses[event.radio == self._addresses[0]]
            received = encode_reception(event, type(event.radio)(other), rate_index=4, signal_dbm=SIGNAL_DBM)
            if received is not None:
                self._kernel.send(received)
            self.report(event, [1], acknowledged=True)
        return None

    def report(self, frame: SentFrame, tries: list[int], *, acknowledged: bool) -> None:
        """Report the status of a frame to the kernel."""
        status = encode_status(frame, tries=tries, acknowledged=acknowledged, signal_dbm=SIGNAL_DBM)
        self._kernel.send(status)


def record(trace: dict[str, Any], cell: Cell, sender: PacketSender, receiver: bytes) -> None:
    """Send the frames of the trace to an address, and print the rates that the kernel selected."""
    start_ns = time.monotonic_ns()
    for number in range(len(trace["levels"])):
        while time.monotonic_ns() < start_ns + number * trace["step_ns"]:
            cell.poll()
            time.sleep(_IDLE_S)
        sender.send(receiver, trace["payload_bytes"])
        while (frame := cell.poll()) is None:
            pass
        time_us = (time.monotonic_ns() - start_ns) // 1000
        tries, acknowledged = tries_of(trace, number, frame.stages)
        cell.report(frame, tries, acknowledged=acknowledged)
        stages = " ".join(f"{stage.index}:{stage.tries}:{stage.flags}" for stage in frame.stages)
        sys.stdout.write(f"{time_us},{stages},{sum(tries)}{'+' * acknowledged}\n")


def main() -> None:
    """Join both radios to a cell and record."""
    trace = json.loads(Path(sys.argv[1]).read_text(encoding="ascii"))
    kernel = open_registered()
    radios = find_radios()[:2]
    cell = Cell(kernel, radios)
    for radio in radios:
        _run("iw", "dev", radio.interface, "set", "type", "ibss")
        _run("ip", "link", "set", radio.interface, "up")
        _run("iw", "dev", radio.interface, *_CELL)
    end_s = time.monotonic() + _JOIN_S
    while "Station" not in _run("iw", "dev", radios[0].interface, "station", "dump"):
        if time.monotonic() > end_s:
            sys.exit("the radios did not join the cell")
        until_s = time.monotonic() + _POLL_S
        while time.monotonic() < until_s:
            cell.poll()
    sender = PacketSender(radios[0].interface)
    record(trace, cell, sender, interface_address(radios[1].interface))
    sender.close()
    kernel.close()


def _run(*argv: str) -> str:
    return subprocess.run(argv, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    main()
