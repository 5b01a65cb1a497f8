"""The recorder: an observer that writes what it sees into a folder, in parts that a kill leaves readable."""

import errno
import os
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.observer import Window
from sim_backends.cosim.recording import tables
from sim_backends.cosim.recording.captures import Captures
from sim_backends.cosim.recording.manifest import (
    About,
    RunEnding,
    RunManifest,
    being_written,
    versions,
    write_manifest,
)
from sim_backends.cosim.recording.samples import EVERY_NS, Sampling
from sim_backends.cosim.recording.state import RecordingState, state_rows
from sim_backends.network.ip import Fragment
from sim_backends.world.motion import State

_MOST_WINDOWS: Final = 50_000
"""In a part: until it is written it is in memory."""
_FULL: Final = {errno.ENOSPC, errno.EDQUOT}
_RESERVE: Final = ".reserve"
_RESERVE_BYTES: Final = 1 << 20
"""Room on the disk that is set aside for the last windows and the end of a run whose disk gets full."""
_NOT_KEPT: Final[Mapping[str, State]] = {}


class RecordingError(ConfigurationError):
    """A recording cannot be written on: what it had stays readable."""


class RunRecorder:
    """Records a run into a folder; a context manager, whose body runs it.

    While the run goes on it takes note of windows. Every two seconds or so of wall time it writes them as one more
    part of each table; the part of `windows` comes last, and says that those of the same number are whole. So a run
    that is killed keeps all but its last seconds.

    Args:
        folder: Where to; made when the run begins, so that a scenario that is refused leaves none.
        about: What is run.
        states_every_ns: How often true states are recorded, at ends of windows: simulated nanoseconds.
        part_every_s: How often a part is written: seconds of wall time.
        snap_bytes: How much of each IP packet is kept in `captures/`, which has a file for each robot, where the
            network is given `log_ip`.
    """

    def __init__(
        self,
        folder: Path,
        about: About,
        *,
        states_every_ns: int = EVERY_NS,
        part_every_s: float = 2.0,
        snap_bytes: int = 128,
    ) -> None:
        self._folder = folder
        self._part_every_s = part_every_s
        self._sampling = Sampling(states_every_ns)
        self._snap_bytes = snap_bytes
        self._captures: Captures | None = None
        self._first_states = _NOT_KEPT
        self._windows: list[Window] = []
        self._state = RecordingState()
        self._written_s = time.perf_counter()
        self._manifest = RunManifest(about, about.scenario_hash, versions=versions())
        self._lock = ExitStack()
        self._begun = False
        self._broken = False

    def begin(self, states: Mapping[str, State]) -> None:
        """Make the folder; see `WindowObserver.begin`.

        Raises:
            ConfigurationError: There is a recording already.
            RecordingError: The folder cannot be written.
        """
        try:
            for table in tables.TABLES:
                (self._folder / table).mkdir(parents=True)
            self._lock.enter_context(being_written(self._folder))
            self._set_reserve_aside()
            write_manifest(self._folder, self._manifest)
        except FileExistsError as error:
            raise ConfigurationError(
                "there is a recording already", where=str(self._folder), remedy="name a folder that is not there yet"
            ) from error
        except OSError as error:
            raise self._error(error) from error
        self._first_states = states
        self._begun = True

    def log_ip(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Take an IP packet that a robot sent or that arrived at it; see `RadioNetwork.log_ip`."""
        if self._captures is None:
            self._captures = Captures(self._folder / "captures", sorted(self._first_states), self._snap_bytes)
        self._captures.log(at_ns, name, fragment)

    def window(self, window: Window) -> None:
        """See `WindowObserver.window`.

        Raises:
            RecordingError: A part cannot be written.
        """
        kept = window.states if self._sampling.is_due(window.end_ns) else _NOT_KEPT
        # States of all windows would fill the memory.
        self._windows.append(Window(*window[:5], kept, _NOT_KEPT, window.wall_s))
        if len(self._windows) >= _MOST_WINDOWS or time.perf_counter() - self._written_s >= self._part_every_s:
            self._write_part()
            self._written_s = time.perf_counter()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Write what is left, and how the run ended.

        Raises:
            RecordingError: That cannot be written.
        """
        if not self._begun:
            return
        with self._lock:
            self._end(error)

    def _end(self, error: BaseException | None) -> None:
        ending = RunEnding.WHOLE
        if error is not None:
            ending = RunEnding.INTERRUPTED if isinstance(error, KeyboardInterrupt) else RunEnding.FAILED
        why = f"{type(error).__name__}: {error}" if ending is RunEnding.FAILED else ""
        if not self._broken:
            self._write_part(last=True)
        self._close()
        self._free_reserve()
        self._manifest = replace(
            self._manifest,
            ending=ending,
            why=why,
            digest="" if self._broken else self._state.digest.hexdigest(),
            parts=self._state.checksums,
        )
        try:
            write_manifest(self._folder, self._manifest)
        except OSError as failure:
            if not self._broken:  # else it was told already
                raise self._error(failure) from failure

    def _close(self) -> None:
        """Close the captures; an error of a disk that refuses to is told once, and hides no other."""
        try:
            if self._captures is not None:
                self._captures.close()
        except OSError as error:
            if not self._broken:
                raise self._error(error) from error

    def _write_part(self, *, last: bool = False) -> None:
        """Write what is not written yet; who interrupts it finds nothing counted twice.

        Where the disk is full, tables come before captures: they get the room that was set aside for them, and of the
        windows as many as that holds.

        Raises:
            RecordingError: Something of it cannot be written.
        """
        failure: OSError | None = None
        try:
            if self._captures is not None:
                self._captures.flush()
        except OSError as error:
            failure = error
            self._free_reserve()
        many = len(self._windows)
        while many or last:
            try:
                self._write_windows(many, last=last and failure is None)
                break
            except OSError as error:
                failure = failure or error
                self._free_reserve()
                if not many:
                    break
                many //= 2
        if failure is not None:
            raise self._error(failure) from failure

    def _write_windows(self, many: int, *, last: bool) -> None:
        """Write the first windows that are not written yet as a part of each table."""
        state, windows = self._state.copy(), self._windows[:many]
        rows = state.take(windows)
        if not state.parts:
            rows["states"] = state_rows(0, self._first_states) + rows["states"]
        if last:
            rows["packets"] += state.end()
        written: list[Path] = []
        try:
            for table, its_rows in rows.items():
                path = tables.part_path(table, state.parts)
                written.append(self._folder / path)
                state.checksums[path] = tables.write_part(self._folder, table, state.parts, its_rows)
        except OSError:
            for unfinished in written:  # the room that they take is needed
                with suppress(OSError):
                    unfinished.unlink(missing_ok=True)
            raise
        state.parts += 1
        self._state, self._windows = state, self._windows[many:]

    def _set_reserve_aside(self) -> None:
        """Set room aside; not on a file system that cannot, or where no file may be as large.

        Raises:
            OSError: There is no such room.
        """
        descriptor = os.open(self._folder / _RESERVE, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, _RESERVE_BYTES)
        except OSError as error:
            self._free_reserve()
            if error.errno in _FULL:
                raise
        finally:
            os.close(descriptor)

    def _free_reserve(self) -> None:
        with suppress(OSError):
            (self._folder / _RESERVE).unlink(missing_ok=True)

    def _error(self, error: OSError) -> RecordingError:
        self._broken = True
        return RecordingError(
            f"the recording cannot be written: {error.strerror}; what it had stays readable",
            where=str(self._folder),
            remedy="free some space" if error.errno in {*_FULL, errno.EFBIG} else "choose another folder",
        )
