"""The evidence of one attempt: a folder of files, each read when it is first asked for, and once."""

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
    """Evidence of one attempt; gates, measures, reports and exports read through it.

    A file that is missing, unreadable or damaged is so for everybody: what reading it raised is kept too.

    Args:
        folder: The attempt's folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._read: dict[Hashable, Any] = {}
        self._failed: dict[Hashable, EvidenceError] = {}
        self._found: dict[Hashable, Any] = {}

    def read(self, parse: Callable[Concatenate[Path, P], T], name: str, *options: P.args, **none: P.kwargs) -> T:
        """Return a piece of evidence.

        Args:
            parse: Reads it; called once for each file and its options.
            name: Its file, empty for one that reads several of the folder.
            options: Handed to `parse` behind the path.
            none: Nothing: a call has one form, so that it is known again.

        Raises:
            EvidenceError: It is missing, or not what it must be.
            MemoryError: This machine has too little.
        """
        key = parse, name, options
        if key in self._failed:
            raise self._failed[key]
        if key not in self._read:
            try:
                self._read[key] = parse(self.folder / name, *options, **none)
            except EvidenceError as error:
                self._failed[key] = error
                raise
            except MemoryError:  # of this machine: elsewhere the same file can be read
                raise
            except Exception as error:  # whatever a reader did not foresee, the file made it
                what = f"cannot be read: {type(error).__name__}: {error}"
                self._failed[key] = EvidenceError(what, where=str(self.folder / name))
                raise self._failed[key] from error
        found: T = self._read[key]
        return found

    def read_or_none(
        self, parse: Callable[Concatenate[Path, P], T], name: str, *options: P.args, **none: P.kwargs
    ) -> T | None:
        """Return a piece of evidence, None when it is missing or not what it must be."""
        try:
            return self.read(parse, name, *options, **none)
        except EvidenceError:
            return None

    def cached(self, find: "Callable[Concatenate[AttemptEvidence, P], T]", *options: P.args, **none: P.kwargs) -> T:
        """Return what `find` finds in the evidence, by `options`; it looks once, whoever asks.

        What it raises is not kept.
        """
        key = find, options
        if key not in self._found:
            self._found[key] = find(self, *options, **none)
        found: T = self._found[key]
        return found

    def has(self, name: str) -> bool:
        """Return whether there is a file of this name."""
        return (self.folder / name).is_file()

    def links(self, role: Role) -> Sequence[LinkSample]:
        """Return what a robot's radio told of its links, in the order of time: a testbed's samples, else its own."""
        modelled = self.read_or_none(link_samples.read, link_samples.FILE) or {}
        return modelled.get(role) or self.read_or_none(link_samples.read_own, "", role) or ()

    def counters(self, role: Role) -> Counters:
        """Return how the counters of a robot's kernel moved during the attempt; None in each that is not known."""
        before, after = (self.read_or_none(host.read, file(role)) for file in (host.before, host.after))
        return host.difference(before or Counters(None, None), after or Counters(None, None))

    def interface_bytes(self, role: Role, interface: str) -> int | None:
        """Return how many bytes an interface received during the attempt; None if its kernel does not say."""
        files = (file(role) for file in (host.before, host.after))
        before, after = (self.read_or_none(host.received_bytes, file, interface) for file in files)
        return None if before is None or after is None or after < before else after - before

    def whole_capture(self, name: str | None) -> Capture | None:
        """Return the capture in a file; None where it is missing or damaged, or there is to be none.

        Counts from a damaged one would be guesses.
        """
        capture = None if name is None else self.read_or_none(pcap.read, name)
        return None if capture is None or capture.damage else capture
