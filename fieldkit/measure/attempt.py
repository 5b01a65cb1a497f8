"""The evidence of one attempt at a repeat: a folder whose files are read on first use and cached."""

from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Role
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import host, link_samples
from fieldkit.measure.evidence.host import Counters

P = ParamSpec("P")
T = TypeVar("T")


class AttemptEvidence:
    """Evidence of one attempt. Gates (checks that void a repeat), measurements, reports and exports read it.

    Errors are cached as well: every later read of a missing, unreadable or damaged file raises the same error.

    Args:
        folder: The attempt's folder.

    Attributes:
        folder: The attempt's folder.
        unexpected_errors: File names, each with an exception that the reader of the file does not document.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.unexpected_errors: list[tuple[str, Exception]] = []
        self._contents: dict[Hashable, Any] = {}
        self._errors: dict[Hashable, EvidenceError] = {}
        self._results: dict[Hashable, Any] = {}

    def read(self, parse: Callable[Concatenate[Path, P], T], name: str, *options: P.args, **keywords: P.kwargs) -> T:
        """Return the parsed content of a file.

        Args:
            parse: Function that reads the file. It is called once for each combination of file and options.
            name: The file's name; empty if `parse` reads several files of the folder.
            options: Passed to `parse` after the path.
            keywords: Must be empty: only the positional options are part of the cache key.

        Raises:
            EvidenceError: The file is missing or invalid.
            MemoryError: This machine has too little memory.
        """
        key = parse, name, options
        if key in self._errors:
            raise self._errors[key]
        if key not in self._contents:
            try:
                self._contents[key] = parse(self.folder / name, *options, **keywords)
            except EvidenceError as error:
                self._errors[key] = error
                raise
            except MemoryError:  # not cached, because it is not caused by the file
                raise
            except Exception as error:  # a reader's unexpected error is caused by the file's content
                self.unexpected_errors.append((name or "its files", error))
                reason = f"cannot be read: {type(error).__name__}: {error}"
                self._errors[key] = EvidenceError(reason, where=str(self.folder / name))
                raise self._errors[key] from error
        content: T = self._contents[key]
        return content

    def read_or_none(
        self, parse: Callable[Concatenate[Path, P], T], name: str, *options: P.args, **keywords: P.kwargs
    ) -> T | None:
        """Return the parsed content of a file, or None if it is missing or invalid."""
        try:
            return self.read(parse, name, *options, **keywords)
        except EvidenceError:
            return None

    def cached(
        self, compute: "Callable[Concatenate[AttemptEvidence, P], T]", *options: P.args, **keywords: P.kwargs
    ) -> T:
        """Return the result of `compute` for this evidence and the options.

        `compute` is called once for each combination of options. Its exceptions are not cached.
        """
        key = compute, options
        if key not in self._results:
            self._results[key] = compute(self, *options, **keywords)
        result: T = self._results[key]
        return result

    def has(self, name: str) -> bool:
        """Return True if the folder has a file of this name."""
        return (self.folder / name).is_file()

    def links(self, role: Role) -> Sequence[LinkSample]:
        """Return the link samples of a robot in the order of time; empty if there are none.

        They are read from the testbed's file, which a testbed with modelled radios writes. If it has no samples of
        this robot, they are read from the files that the robot wrote.
        """
        testbed_samples = self.read_or_none(link_samples.read, link_samples.FILE) or {}
        if samples := testbed_samples.get(role):
            return samples
        from fieldkit.measure.evidence import robot_link_samples  # noqa: PLC0415 (needed only for real radios)

        return self.read_or_none(robot_link_samples.read, "", role) or ()

    def counters(self, role: Role) -> Counters:
        """Return the increments of a robot's kernel counters during the attempt; None for an unknown increment."""
        before, after = (
            self.read_or_none(host.read_counters, file(role)) for file in (host.before_file, host.after_file)
        )
        return host.increments(before or Counters(None, None), after or Counters(None, None))

    def interface_bytes(self, role: Role, interface: str) -> int | None:
        """Return the number of bytes that an interface received during the attempt.

        None if a counter is missing, or has decreased because of a restart.
        """
        files = (file(role) for file in (host.before_file, host.after_file))
        before, after = (self.read_or_none(host.received_bytes, file, interface) for file in files)
        return None if before is None or after is None or after < before else after - before

    def undamaged_capture(self, name: str | None) -> Capture | None:
        """Return a capture, or None if `name` is None, or the file is missing, invalid or damaged.

        A damaged capture would give wrong counts.
        """
        capture = None if name is None else self.read_or_none(pcap.read, name)
        return None if capture is None or capture.damage else capture
