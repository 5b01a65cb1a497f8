"""Reads the record of a run from a recording; raises an error if the recording was changed or truncated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldkit.core.errors import EvidenceError
from sim_backends.cosim.recording import packet_tables
from sim_backends.cosim.recording.manifest import RUN_AGAIN, RunManifest, read_manifest
from sim_backends.cosim.run_record import EventDigest, Fate, Run
from sim_backends.network.packets import Packet
from sim_backends.world.motion import State


@dataclass(frozen=True)
class Recording:
    """A recording.

    Attributes:
        manifest: The scenario and its settings, and the end of the run.
        run: The run. If it is under way or was killed, the packets whose fate was not decided yet are missing.
        states: The recorded true states: time in nanoseconds, agent, state.
        decided_by: Reason for the length of each window; empty texts if the policy reports no reasons.
    """

    manifest: RunManifest
    run: Run
    states: list[tuple[int, str, State]]
    decided_by: list[str]


def read_recording(folder: Path) -> Recording:
    """Read a recording, also of a run that is under way or was killed.

    Raises:
        EvidenceError: The recording does not exist, is damaged, or was changed or truncated after the run.
    """
    manifest = read_manifest(folder)
    _check_parts(folder, manifest)
    parts = sum(1 for _ in (folder / "windows").glob("*.parquet"))
    windows, packets, states = (
        packet_tables.read_parts(folder, table, parts) for table in ("windows", "packets", "states")
    )
    fates = [_fate(dict(zip(packets, row, strict=True))) for row in zip(*packets.values(), strict=True)]
    run = Run(windows_ns=windows["end_ns"])
    run.fates = {fate.packet.identity: fate for fate in sorted(fates, key=lambda fate: fate.packet.packet_id)}
    for part in run.wall_s:
        # The times are added in the same order as in the run, so that all bits of the sum are equal.
        for spent_s in windows[f"{part}_s"]:
            run.wall_s[part] += spent_s
    if manifest.digest:
        run.digest = _digest(run, fates, packets["entered_window"], packets["ended_window"])
        if run.digest != manifest.digest:
            raise EvidenceError(
                f"the recording was changed or truncated: its events have digest {run.digest}, not {manifest.digest}",
                where=str(folder),
                remedy=RUN_AGAIN,
            )
    true_states = [
        (at_ns, agent, State(position_m, velocity_m_s, heading_rad))
        for at_ns, agent, position_m, velocity_m_s, heading_rad in zip(*states.values(), strict=True)
    ]
    return Recording(manifest, run, true_states, windows["decided_by"])


def _check_parts(folder: Path, manifest: RunManifest) -> None:
    for path, checksum in manifest.parts.items():
        try:
            is_same = packet_tables.file_checksum(folder / path) == checksum
        except OSError as error:
            raise EvidenceError(
                f"a part of the recording is missing or cannot be read: {error.strerror}",
                where=str(folder / path),
                remedy=RUN_AGAIN,
            ) from error
        if not is_same:
            raise EvidenceError("the recording was changed after the run", where=str(folder / path), remedy=RUN_AGAIN)


def _digest(
    run: Run, fates: Sequence[Fate], entered_windows: Sequence[int], ended_windows: Sequence[int | None]
) -> str:
    """Return the digest of the recorded events; `fates` is in the order in which they were decided."""
    window_by_packet = {fate.packet.packet_id: window for fate, window in zip(fates, entered_windows, strict=True)}
    entered_by_window: dict[int, list[Fate]] = {}
    for fate in run.fates.values():
        entered_by_window.setdefault(window_by_packet[fate.packet.packet_id], []).append(fate)
    ended_by_window: dict[int | None, list[Fate]] = {}
    for fate, window in zip(fates, ended_windows, strict=True):
        ended_by_window.setdefault(window, []).append(fate)
    digest = EventDigest()
    for window, end_ns in enumerate(run.windows_ns):
        digest.add_window(end_ns, entered_by_window.get(window, ()), ended_by_window.get(window, ()))
    return digest.hexdigest()


def _fate(row: Mapping[str, Any]) -> Fate:
    packet = Packet(
        row["packet_id"],
        row["source"],
        row["destination"],
        row["size_bytes"],
        (row["flow"], row["number"]),
        row["sent_ns"],
        row["enters_ns"],
        row["protocol"],
    )
    # The columns `known_*` contain the states that the network assumed.
    assumed, true = (
        (_state(row, f"{prefix}_source"), _state(row, f"{prefix}_destination")) for prefix in ("known", "true")
    )
    return Fate(packet, assumed, true, row["arrived_ns"], row["counted_ns"], row["late_ns"], row["reason"])


def _state(row: Mapping[str, Any], prefix: str) -> State:
    return State(row[f"{prefix}_m"], row[f"{prefix}_m_s"], row[f"{prefix}_heading_rad"])
