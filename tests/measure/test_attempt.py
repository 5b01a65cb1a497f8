"""Evidence of an attempt: each file is read once, and all callers receive the same result or error."""

import struct
from pathlib import Path

import pytest

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.evidence.tcpdump_log import capture_file
from tests.helpers.captures import datagram, file_bytes, timed


class Parser:
    """A parser of words that records its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def words(self, path: Path, at_least: int = 0) -> list[str]:
        self.calls.append((path.name, at_least))
        try:
            words = path.read_text(encoding="utf-8").split()
        except OSError as error:
            raise EvidenceError("cannot be read", where=str(path)) from error
        if len(words) < at_least:
            raise EvidenceError("too short", where=str(path))
        return words


def test_a_file_is_parsed_once_for_all_callers(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("one two", encoding="utf-8")
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    first = evidence.read(parser.words, "a.txt")
    (tmp_path / "a.txt").write_text("three", encoding="utf-8")
    assert evidence.read(parser.words, "a.txt") is evidence.read_or_none(parser.words, "a.txt") is first
    assert first == ["one", "two"]
    assert parser.calls == [("a.txt", 0)]


def test_other_files_arguments_and_attempts_are_read_separately(tmp_path: Path) -> None:
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text(name, encoding="utf-8")
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    assert evidence.read(parser.words, "a.txt") == ["a.txt"]
    assert evidence.read(parser.words, "b.txt") == ["b.txt"]
    assert evidence.read(parser.words, "a.txt", 1) == ["a.txt"]
    assert AttemptEvidence(tmp_path).read(parser.words, "a.txt") == ["a.txt"]
    assert parser.calls == [("a.txt", 0), ("b.txt", 0), ("a.txt", 1), ("a.txt", 0)]


def test_an_error_is_raised_again_without_another_read(tmp_path: Path) -> None:
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    with pytest.raises(EvidenceError) as first_error:
        evidence.read(parser.words, "a.txt")
    (tmp_path / "a.txt").write_text("late", encoding="utf-8")
    assert evidence.read_or_none(parser.words, "a.txt") is None
    with pytest.raises(EvidenceError) as second_error:
        evidence.read(parser.words, "a.txt")
    assert second_error.value is first_error.value
    assert parser.calls == [("a.txt", 0)]


def test_an_error_that_was_ignored_once_is_raised_by_read(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("one", encoding="utf-8")
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    assert evidence.read_or_none(parser.words, "a.txt", 2) is None
    with pytest.raises(EvidenceError, match="too short"):
        evidence.read(parser.words, "a.txt", 2)
    assert parser.calls == [("a.txt", 2)]


def test_a_cached_result_is_computed_once(tmp_path: Path) -> None:
    computations: list[tuple[Path, int]] = []

    def compute(evidence: AttemptEvidence, number: int) -> None:
        computations.append((evidence.folder, number))

    evidence = AttemptEvidence(tmp_path)
    for number in (1, 1, 2, 1):
        assert evidence.cached(compute, number) is None
    assert computations == [(tmp_path, 1), (tmp_path, 2)]


def test_only_a_regular_file_is_evidence(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    evidence = AttemptEvidence(tmp_path)
    assert [evidence.has(name) for name in ("file", "folder", "none")] == [True, False, False]


def test_a_damaged_capture_is_not_counted(tmp_path: Path) -> None:
    data = file_bytes(timed(datagram(1, 4000)))
    (tmp_path / capture_file(Role.SENDER)).write_bytes(data)
    (tmp_path / capture_file(Role.RECEIVER)).write_bytes(data[:-1])
    evidence = AttemptEvidence(tmp_path)
    frames = evidence.undamaged_capture(capture_file(Role.SENDER))
    assert frames is not None
    assert (frames.frames, frames.damage) == (3, None)
    assert (
        evidence.undamaged_capture(capture_file(Role.SENDER))
        is frames
        is evidence.read(pcap.read, capture_file(Role.SENDER))
    )
    # The damaged capture can still be read explicitly, but not with `undamaged_capture`.
    assert evidence.undamaged_capture(capture_file(Role.RECEIVER)) is None
    assert evidence.read(pcap.read, capture_file(Role.RECEIVER)).damage
    assert evidence.undamaged_capture(capture_file(Role.RELAY)) is None
    assert evidence.undamaged_capture(None) is None


@pytest.mark.parametrize("error", [RecursionError, OverflowError, struct.error, KeyError])
def test_any_error_of_a_reader_becomes_an_evidence_error(tmp_path: Path, error: type[Exception]) -> None:
    def raise_error(path: Path) -> None:
        raise error("no such number")

    evidence = AttemptEvidence(tmp_path)
    assert evidence.read_or_none(raise_error, "a.txt") is None
    with pytest.raises(EvidenceError, match=f"cannot be read: {error.__name__}") as error_info:
        evidence.read(raise_error, "a.txt")
    assert error_info.value.where == str(tmp_path / "a.txt")
    assert [(name, type(raised_error)) for name, raised_error in evidence.unexpected_errors] == [("a.txt", error)]


def test_a_memory_error_is_not_an_evidence_error(tmp_path: Path) -> None:
    def raise_error(path: Path) -> None:
        raise MemoryError

    with pytest.raises(MemoryError):
        AttemptEvidence(tmp_path).read_or_none(raise_error, "a.txt")
