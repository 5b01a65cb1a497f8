"""Replay: reads a recording back as the run that it was, and tells one that was changed or cut."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldkit.core.errors import EvidenceError
from sim_backends.cosim.digest import EventDigest
from sim_backends.cosim.recording import tables
from sim_backends.cosim.recording.manifest import RUN_AGAIN, RunManifest, read_manifest
from sim_backends.cosim.run import Fate, Run
from sim_backends.network.packets import Packet
from sim_backends.world.motion import State


@dataclass(frozen=True)
class Recording:
    """A recording.

    Attributes:
        manifest: What was run, and how it ended.
        run: The run. Of one that is under way, or was killed, packets are missing whose fate was not known yet.
        states: True states, as they were recorded: when, whose, and what.
        decided_by: What decided the length of each window, empty where the policy did not say.
    """

    manifest: RunManifest
    run: Run
    states: list[tuple[int, str, State]]
    decided_by: list[str]


def read_recording(folder: Path) -> Recording:
    """Read a recording, also of a run that goes on or was killed.

    Raises:
        EvidenceError: There is none, it is damaged, or it was changed or cut after the run.
    """
    manifest = read_manifest(folder)
    _check_parts(folder, manifest)
    parts = sum(1 for _ in (folder / "windows").glob("*.parquet"))
    windows, packets, states = (tables.read_parts(folder, table, parts) for table in ("windows", "packets", "states"))
    fates = [_fate(dict(zip(packets, row, strict=True))) for row in zip(*packets.values(), strict=True)]
    run = Run(windows_ns=windows["end_ns"])
    run.fates = {fate.packet.identity: fate for fate in sorted(fates, key=lambda fate: fate.packet.packet_id)}
    for part in run.wall_s:
        # In the order and by the operation of the run itself, so that the last bit is the same.
        for spent_s in windows[f"{part}_s"]:
            run.wall_s[part] += spent_s
    if manifest.digest:
        run.digest = _digest(run, fates, packets["entered_window"], packets["ended_window"])
        if run.digest != manifest.digest:
            raise EvidenceError(
                f"the recording was changed or cut: its events have digest {run.digest}, not {manifest.digest}",
                where=str(folder),
                remedy=RUN_AGAIN,
            )
    true = [
        (at_ns, agent, State(position_m, velocity_m_s, heading_rad))
        for at_ns, agent, position_m, velocity_m_s, heading_rad in zip(*states.values(), strict=True)
    ]
    return Recording(manifest, run, true, windows["decided_by"])


def _check_parts(folder: Path, manifest: RunManifest) -> None:
    for path, checksum in manifest.parts.items():
        try:
            same = tables.checksum(folder / path) == checksum
        except OSError as error:
            raise EvidenceError(
                f"the recording was cut: this part cannot be read: {error.strerror}",
                where=str(folder / path),
                remedy=RUN_AGAIN,
            ) from error
        if not same:
            raise EvidenceError("the recording was changed after the run", where=str(folder / path), remedy=RUN_AGAIN)


def _digest(run: Run, fates: Sequence[Fate], entered: Sequence[int], ended: Sequence[int | None]) -> str:
    """Return the digest of what was read; `fates` in the order in which they became known."""
    windows_of = {fate.packet.packet_id: window for fate, window in zip(fates, entered, strict=True)}
    entered_in: dict[int, list[Fate]] = {}
    for fate in run.fates.values():
        entered_in.setdefault(windows_of[fate.packet.packet_id], []).append(fate)
    ended_in: dict[int | None, list[Fate]] = {}
    for fate, window in zip(fates, ended, strict=True):
        ended_in.setdefault(window, []).append(fate)
    digest = EventDigest()
    for window, end_ns in enumerate(run.windows_ns):
        digest.window(end_ns, entered_in.get(window, ()), ended_in.get(window, ()))
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
    known, true = ((_state(row, f"{what}_source"), _state(row, f"{what}_destination")) for what in ("known", "true"))
    return Fate(packet, known, true, row["arrived_ns"], row["counted_ns"], row["late_ns"], row["reason"])


def _state(row: Mapping[str, Any], of: str) -> State:
    return State(row[f"{of}_m"], row[f"{of}_m_s"], row[f"{of}_heading_rad"])
