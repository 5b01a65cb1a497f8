"""Captures on monitor interfaces, which the step `capture` takes in addition to the captures of packets.

`capture` imports this module only if it has the key `monitor`, because few trials have such a capture.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Final

from fieldkit.core.columns import Measured
from fieldkit.core.model import Role, Verdict
from fieldkit.measure.captures import radiotap
from fieldkit.measure.captures.radiotap import RadioFrames
from fieldkit.measure.checks import monitor_checks, monitor_columns
from fieldkit.measure.evidence import tcpdump_log
from fieldkit.steps.scene import CommandResult, Need
from fieldkit.steps.view import View

_DATA_LINK: Final = "IEEE802_11_RADIO"
"""tcpdump's name for frames of IEEE 802.11 with radiotap headers."""

_NOT_CAPTURED: Final = "the {role} does not capture"
_INCOMPLETE: Final = "the capture on its monitor interface is incomplete"


def options(interface: str) -> tuple[str, ...]:
    """Return tcpdump's options for a monitor interface."""
    return "-i", interface, "-y", _DATA_LINK


def need(role: Role, prefix: tuple[str, ...], program: str, interface: str) -> Need:
    """Return the check of a monitor interface.

    Args:
        role: Role of the robot.
        prefix: Words before the command, such as those of sudo.
        program: The capture program.
        interface: The monitor interface.
    """
    argv = (*prefix, program, "-L", "-i", interface)
    return Need(role, f"monitor interface {interface}", argv, partial(_judge, interface), required_program=program)


def measure(view: View, files: Mapping[Role, Iterable[str]]) -> Measured:
    """Return the columns of the frames of the radios.

    They are empty if they contradict another source.

    Args:
        view: The attempt.
        files: Files with the packets and with the frames of each robot that captures.
    """
    names = {role: tuple(role_files) for role, role_files in files.items()}
    captures = {role: _complete_frames(view, frames_file) for role, (_, frames_file) in names.items()}
    measured = Measured()
    for role, role_columns in monitor_columns.COLUMNS_BY_ROLE.items():
        frames = captures.get(role)
        if frames is None:
            reason = _INCOMPLETE if role in names else _NOT_CAPTURED.format(role=role)
            measured |= Measured.all_missing(role_columns, reason)
            continue
        result = monitor_columns.measure(role, frames)
        if contradiction := next(_contradictions(view, role, names[role][0], frames, captures), None):
            result = Measured.all_missing(role_columns, contradiction)
        measured |= result
    return measured


def _contradictions(
    view: View, role: Role, packets_file: str, frames: RadioFrames, captures: Mapping[Role, RadioFrames | None]
) -> Iterator[str]:
    """Yield each contradiction between a capture on a monitor interface and another source."""
    yield from monitor_checks.link_contradictions(frames, view.evidence.links(role))
    packets = view.evidence.undamaged_capture(packets_file)
    if packets is not None:
        address = view.scene.robot(role).address
        yield from monitor_checks.packet_contradictions(frames, packets.packets, address)
    for other_role, other_frames in captures.items():
        if other_role != role and other_frames is not None:
            yield from monitor_checks.peer_contradictions(other_frames, frames)
            yield from monitor_checks.peer_contradictions(frames, other_frames)


def _complete_frames(view: View, name: str) -> RadioFrames | None:
    """Return the frames in a file, or None if it is missing or damaged, or frames were dropped."""
    capture = view.evidence.read_or_none(radiotap.read, name)
    log = view.evidence.read_or_none(tcpdump_log.read, tcpdump_log.capture_log_file(name))
    if capture is None or capture.damage or log is None or log.dropped_by_kernel or log.dropped_by_interface:
        return None
    return capture.frames


def _judge(interface: str, result: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the list of link types of the interface."""
    if result.ok and _DATA_LINK in result.text:
        return Verdict.OK, "with radiotap headers", ""
    detail = f"{interface} is not in monitor mode" if result.ok else result.text
    return (
        Verdict.FAIL,
        detail,
        f"sudo iw dev wlan0 interface add {interface} type monitor; sudo ip link set {interface} up",
    )
