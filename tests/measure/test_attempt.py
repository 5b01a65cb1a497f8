"""Evidence of an attempt: each file is read once, whatever comes of it and whoever asks."""

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
    """Reads words, and counts how often it was called."""

    def __init__(self) -> None:
        self.called: list[tuple[str, int]] = []

    def words(self, path: Path, at_least: int = 0) -> list[str]:
        self.called.append((path.name, at_least))
        try:
            found = path.read_text(encoding="utf-8").split()
        except OSError as error:
            raise EvidenceError("cannot be read", where=str(path)) from error
        if len(found) < at_least:
            raise EvidenceError("too short", where=str(path))
        return found


def test_a_file_is_parsed_once_whoever_asks(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("one two", encoding="utf-8")
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    first = evidence.read(parser.words, "a.txt")
    (tmp_path / "a.txt").write_text("three", encoding="utf-8")
    assert evidence.read(parser.words, "a.txt") is evidence.read_or_none(parser.words, "a.txt") is first
    assert first == ["one", "two"]
    assert parser.called == [("a.txt", 0)]


def test_another_file_other_options_and_another_attempt_are_read_for_themselves(tmp_path: Path) -> None:
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text(name, encoding="utf-8")
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    assert evidence.read(parser.words, "a.txt") == ["a.txt"]
    assert evidence.read(parser.words, "b.txt") == ["b.txt"]
    assert evidence.read(parser.words, "a.txt", 1) == ["a.txt"]
    assert AttemptEvidence(tmp_path).read(parser.words, "a.txt") == ["a.txt"]
    assert parser.called == [("a.txt", 0), ("b.txt", 0), ("a.txt", 1), ("a.txt", 0)]


def test_an_error_is_raised_again_and_not_looked_for_again(tmp_path: Path) -> None:
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    with pytest.raises(EvidenceError) as first:
        evidence.read(parser.words, "a.txt")
    (tmp_path / "a.txt").write_text("late", encoding="utf-8")
    assert evidence.read_or_none(parser.words, "a.txt") is None
    with pytest.raises(EvidenceError) as again:
        evidence.read(parser.words, "a.txt")
    assert again.value is first.value
    assert parser.called == [("a.txt", 0)]


def test_an_error_that_was_passed_over_is_raised_where_it_matters(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("one", encoding="utf-8")
    evidence, parser = AttemptEvidence(tmp_path), Parser()
    assert evidence.read_or_none(parser.words, "a.txt", 2) is None
    with pytest.raises(EvidenceError, match="too short"):
        evidence.read(parser.words, "a.txt", 2)
    assert parser.called == [("a.txt", 2)]


def test_what_is_found_in_evidence_is_looked_for_once(tmp_path: Path) -> None:
    looked: list[tuple[Path, int]] = []

    def find(evidence: AttemptEvidence, number: int) -> None:
        looked.append((evidence.folder, number))

    evidence = AttemptEvidence(tmp_path)
    for number in (1, 1, 2, 1):
        assert evidence.cached(find, number) is None
    assert looked == [(tmp_path, 1), (tmp_path, 2)]


def test_only_a_file_is_evidence(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    evidence = AttemptEvidence(tmp_path)
    assert [evidence.has(name) for name in ("file", "folder", "none")] == [True, False, False]


def test_a_capture_counts_only_where_it_is_whole(tmp_path: Path) -> None:
    data = file_bytes(timed(datagram(1, 4000)))
    (tmp_path / capture_file(Role.SENDER)).write_bytes(data)
    (tmp_path / capture_file(Role.RECEIVER)).write_bytes(data[:-1])
    evidence = AttemptEvidence(tmp_path)
    whole = evidence.whole_capture(capture_file(Role.SENDER))
    assert whole is not None
    assert (whole.frames, whole.damage) == (3, None)
    assert (
        evidence.whole_capture(capture_file(Role.SENDER))
        is whole
        is evidence.read(pcap.read, capture_file(Role.SENDER))
    )
    # It is there for who asks for it, with its damage; for counts it is not.
    assert evidence.whole_capture(capture_file(Role.RECEIVER)) is None
    assert evidence.read(pcap.read, capture_file(Role.RECEIVER)).damage
    assert evidence.whole_capture(capture_file(Role.RELAY)) is None
    assert evidence.whole_capture(None) is None


@pytest.mark.parametrize("error", [RecursionError, OverflowError, struct.error, KeyError])
def test_whatever_a_reader_raises_is_evidence_that_cannot_be_read(tmp_path: Path, error: type[Exception]) -> None:
    def raises(path: Path) -> None:
        raise error("no such number")

    evidence = AttemptEvidence(tmp_path)
    assert evidence.read_or_none(raises, "a.txt") is None
    with pytest.raises(EvidenceError, match=f"cannot be read: {error.__name__}") as caught:
        evidence.read(raises, "a.txt")
    assert caught.value.where == str(tmp_path / "a.txt")


def test_too_little_memory_says_nothing_of_the_evidence(tmp_path: Path) -> None:
    def raises(path: Path) -> None:
        raise MemoryError

    with pytest.raises(MemoryError):
        AttemptEvidence(tmp_path).read_or_none(raises, "a.txt")
