"""Records a run during its execution: tables in parts, captures, `run.json`, and samples of the true states."""

import errno
import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.recording import packet_tables
from sim_backends.cosim.recording.captures import NO_FLOWS, CapturedFlow, Captures
from sim_backends.cosim.recording.manifest import (
    RunEnding,
    RunManifest,
    RunSettings,
    recording_lock,
    software_versions,
    write_manifest,
)
from sim_backends.cosim.recording.packet_tables import RecordingState, state_rows
from sim_backends.cosim.run_record import IpObserver, Window, WindowObserver
from sim_backends.network.ip import Fragment
from sim_backends.world.motion import State

SAMPLING_INTERVAL_NS: Final = 100_000_000
"""Default interval at which states are recorded, in simulated time."""


class Sampling:
    """Selects the ends of windows at which states are recorded.

    Args:
        every_ns: Sampling interval, in simulated nanoseconds.
    """

    def __init__(self, every_ns: int = SAMPLING_INTERVAL_NS) -> None:
        self._every_ns = every_ns
        self._due_ns = every_ns

    def is_due(self, end_ns: int) -> bool:
        """Return True if the states at the end of a window must be recorded; call it once per window, in order."""
        if end_ns < self._due_ns:
            return False
        self._due_ns = (end_ns // self._every_ns + 1) * self._every_ns
        return True


class StateSamples:
    """An observer that keeps the sampled states of a recording in memory, and forwards all calls to a recorder.

    Args:
        recorder: The recorder, or None.

    Attributes:
        states: Time in nanoseconds, agent and state, in the form of `Recording.states`.
        log_ip: The recorder's method; missing if the recorder does not accept IP packets.
    """

    log_ip: Callable[[int, str, Fragment], None]

    def __init__(self, recorder: WindowObserver | None = None) -> None:
        self._recorder = recorder
        self._sampling = Sampling()
        self.states: list[tuple[int, str, State]] = []
        if isinstance(recorder, IpObserver):
            self.log_ip = recorder.log_ip

    def begin(self, states: Mapping[str, State]) -> None:
        """Add the states at time 0."""
        self.states += [(0, name, state) for name, state in states.items()]
        if self._recorder is not None:
            self._recorder.begin(states)

    def window(self, window: Window) -> None:
        """Add the states at the end of a window if they are due."""
        if self._sampling.is_due(window.end_ns):
            self.states += [(window.end_ns, name, state) for name, state in window.states.items()]
        if self._recorder is not None:
            self._recorder.window(window)


PART_S: Final = 2.0
"""Default interval at which parts are written, in seconds of wall time."""
_MAX_WINDOWS: Final = 50_000
"""Largest number of windows in a part, because a part is in memory until it is written."""
_DISK_FULL_ERRORS: Final = {errno.ENOSPC, errno.EDQUOT}
CAPTURES: Final = "captures"
"""Folder of the captures in a recording, with a file for each robot, `ROBOT.pcap`."""
_RESERVE: Final = ".reserve"
"""File that occupies disk space; it is deleted when the run ends or the disk is full."""
_RESERVE_BYTES: Final = 1 << 20
"""Size of this file: space for the last windows and the manifest."""
_NO_STATES: Final[Mapping[str, State]] = {}


class RecordingError(ConfigurationError):
    """A recording cannot be continued; the parts written before remain readable."""


class RunRecorder:
    """Records a run into a folder. The run is executed within this context manager.

    Windows are collected in memory. About every two seconds of wall time (`part_every_s`), or after 50,000 windows,
    they are written as one more part of each table. The part of `windows` is written last. If it exists, the parts of
    the other tables with the same number are complete. A run that is killed therefore loses only its last seconds.

    Args:
        folder: The folder; it is created at the start of the run, so an invalid scenario creates none.
        about: The scenario and its settings.
        states_every_ns: Interval at which true states are recorded, at ends of windows, in simulated nanoseconds.
        part_every_s: Interval at which parts are written, in seconds of wall time.
        snap_bytes: Number of bytes of each IP packet that are stored in `captures/`. That folder has a file for each
            robot if the network passes its packets to `log_ip`.
        agents: Agents that may be absent at time 0; `captures/` must also include their packets.
        flows: Flows with special headers in the captures, by name.
    """

    def __init__(
        self,
        folder: Path,
        about: RunSettings,
        *,
        states_every_ns: int = SAMPLING_INTERVAL_NS,
        part_every_s: float = PART_S,
        snap_bytes: int = 128,
        agents: Iterable[str] = (),
        flows: Mapping[str, CapturedFlow] = NO_FLOWS,
    ) -> None:
        self._folder = folder
        self._flows = flows
        self._part_every_s = part_every_s
        self._sampling = Sampling(states_every_ns)
        self._snap_bytes = snap_bytes
        self._agents = frozenset(agents)
        self._captures: Captures | None = None
        self._first_states = _NO_STATES
        self._windows: list[Window] = []
        self._state = RecordingState()
        self._last_write_s = time.perf_counter()
        self._manifest = RunManifest(about, about.scenario_hash, versions=software_versions())
        self._lock = ExitStack()
        self._has_begun = False
        self._has_failed = False

    def begin(self, states: Mapping[str, State]) -> None:
        """Create and lock the folder.

        Raises:
            ConfigurationError: There is already a recording.
            RecordingError: The folder cannot be written.
        """
        try:
            for table in packet_tables.TABLES:
                (self._folder / table).mkdir(parents=True)
            self._lock.enter_context(recording_lock(self._folder))
            self._allocate_reserve()
            write_manifest(self._folder, self._manifest)
        except FileExistsError as error:
            raise ConfigurationError(
                "there is already a recording", where=str(self._folder), remedy="choose a folder that does not exist"
            ) from error
        except OSError as error:
            raise self._error(error) from error
        self._first_states = states
        self._has_begun = True

    def log_ip(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Add an IP packet that a robot sent or that arrived at it; called by the network."""
        if self._captures is None:
            names = sorted({*self._first_states, *self._agents})
            self._captures = Captures(self._folder / CAPTURES, names, self._snap_bytes, self._flows)
        self._captures.log(at_ns, name, fragment)

    def window(self, window: Window) -> None:
        """Add a window, and write a part if it is due.

        Raises:
            RecordingError: A part cannot be written.
        """
        states = window.states if self._sampling.is_due(window.end_ns) else _NO_STATES
        # The states of all windows would need too much memory.
        self._windows.append(window._replace(states=states, assumed_states=_NO_STATES))
        if len(self._windows) >= _MAX_WINDOWS or time.perf_counter() - self._last_write_s >= self._part_every_s:
            self._write_part()
            self._last_write_s = time.perf_counter()

    def __enter__(self) -> Self:
        """Return the recorder."""
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Write the remaining windows and the end of the run.

        Raises:
            RecordingError: Some windows or the end of the run cannot be written.
        """
        if not self._has_begun:
            return
        with self._lock:
            self._finish(error)

    def _finish(self, error: BaseException | None) -> None:
        """Write the remaining windows and the end of the run; `error` is the exception that stopped it, or None."""
        ending = RunEnding.COMPLETE
        if error is not None:
            ending = RunEnding.INTERRUPTED if isinstance(error, KeyboardInterrupt) else RunEnding.FAILED
        error_text = f"{type(error).__name__}: {error}" if ending is RunEnding.FAILED else ""
        if not self._has_failed:
            self._write_part(is_last=True)
        self._close()
        self._free_reserve()
        self._manifest = replace(
            self._manifest,
            ending=ending,
            why=error_text,
            digest="" if self._has_failed else self._state.digest.hexdigest(),
            parts=self._state.checksums,
        )
        try:
            write_manifest(self._folder, self._manifest)
        except OSError as manifest_error:
            if not self._has_failed:  # if writing has failed before, that error was already raised
                raise self._error(manifest_error) from manifest_error

    def _close(self) -> None:
        """Close the captures; if writing has failed before, ignore errors."""
        try:
            if self._captures is not None:
                self._captures.close()
        except OSError as error:
            if not self._has_failed:
                raise self._error(error) from error

    def _write_part(self, *, is_last: bool = False) -> None:
        """Write the collected windows; an interrupt does not cause a window to be counted twice.

        If the disk is full, the reserved space is used for tables, not for captures. If the windows do not fit into
        it, only the first half of them is tried, then the first quarter, and so on.

        Raises:
            RecordingError: Some windows or packets cannot be written.
        """
        failure: OSError | None = None
        try:
            if self._captures is not None:
                self._captures.flush()
        except OSError as error:
            failure = error
            self._free_reserve()
        count = len(self._windows)
        while count or is_last:
            try:
                self._write_windows(count, is_last=is_last and failure is None)
                break
            except OSError as error:
                failure = failure or error
                self._free_reserve()
                if not count:
                    break
                count //= 2
        if failure is not None:
            raise self._error(failure) from failure

    def _write_windows(self, count: int, *, is_last: bool) -> None:
        """Write the first `count` collected windows as a part of each table."""
        state, windows = self._state.copy(), self._windows[:count]
        rows = state.add_windows(windows)
        if not state.parts:
            rows["states"] = state_rows(0, self._first_states) + rows["states"]
        if is_last:
            rows["packets"] += state.undecided_rows()
        written_paths: list[Path] = []
        try:
            for table, table_rows in rows.items():
                path = packet_tables.part_path(table, state.parts)
                written_paths.append(self._folder / path)
                state.checksums[path] = packet_tables.write_part(self._folder, table, state.parts, table_rows)
        except OSError:
            for path_to_remove in written_paths:  # an incomplete part would use disk space
                with suppress(OSError):
                    path_to_remove.unlink(missing_ok=True)
            raise
        state.parts += 1
        self._state, self._windows = state, self._windows[count:]

    def _allocate_reserve(self) -> None:
        """Allocate disk space, unless the file system does not support it or limits the size of files.

        Raises:
            OSError: The disk does not have enough space.
        """
        descriptor = os.open(self._folder / _RESERVE, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, _RESERVE_BYTES)
        except OSError as error:
            self._free_reserve()
            if error.errno in _DISK_FULL_ERRORS:
                raise
        finally:
            os.close(descriptor)

    def _free_reserve(self) -> None:
        with suppress(OSError):
            (self._folder / _RESERVE).unlink(missing_ok=True)

    def _error(self, error: OSError) -> RecordingError:
        """Mark the recording as incomplete, and return the error for the failed write."""
        self._has_failed = True
        return RecordingError(
            f"the recording cannot be written: {error.strerror}; the parts written before remain readable",
            where=str(self._folder),
            remedy="free some space" if error.errno in {*_DISK_FULL_ERRORS, errno.EFBIG} else "choose another folder",
        )
