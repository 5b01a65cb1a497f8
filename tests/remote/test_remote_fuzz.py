"""Any data from a robot remain in the folder, raise only errors of fieldkit, and damage no terminal or table."""

import csv
import hashlib
import io
import subprocess
import sys
import tarfile
import tempfile
import tracemalloc
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.cli import display
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, FieldkitError, LockLostError, RobotError
from fieldkit.core.events import Event, Note, RepeatEnded
from fieldkit.core.model import Status
from fieldkit.core.text import unescape_formula
from fieldkit.remote import archive, fetching, jobs, script
from fieldkit.remote.command import printable, quote
from fieldkit.remote.drain import drain
from fieldkit.remote.shell import Completed
from fieldkit.trial import rows
from fieldkit.trial.columns import trial_columns
from tests.helpers.tables import RepeatRow
from tests.helpers.userlands import LocalShell

CONTROL_CHARACTERS = [
    "\n",
    "\r",
    "\0",
    "\x07",
    "\x9b",
    "\x1b[2J",
    "\x1b]52;c;QQ==\x07",
    "\x1b]8;;x\x07",
    "\u202e",
    "\u2066",
    "\u2028",
]
PATH_PARTS = [
    "..",
    ".",
    "/",
    "//",
    "\\",
    "-",
    "~",
    "*",
    " ",
    "[bold]",
    "[/]",
    "=1+1",
    '"',
    ",",
    "a",
    "B",
    "0",
    ".sums-1",
]
TEXT = st.lists(st.sampled_from(CONTROL_CHARACTERS + PATH_PARTS) | st.text(max_size=3), max_size=8).map("".join)
BYTES = st.lists(TEXT.map(str.encode) | st.binary(max_size=8), max_size=8).map(b"".join)
NAMES = st.sampled_from(["scan.bag", "scan/a", "scan", "../x", "/tmp/x", "scan/../../x", "a//b", "./a"]) | TEXT
FIELD = st.binary(min_size=12, max_size=12) | st.integers(0, 8**11 - 1).map(lambda size: b"%011o\0" % size)


class AnsweringRobot(LocalShell):
    """A robot that answers a fetch with these bytes, and all other calls with this result."""

    def __init__(self, home: Path, content: bytes = b"", *, code: int = 0, stderr: bytes = b"") -> None:
        super().__init__(home)
        self.content = content
        self.code = code
        self.stderr = stderr

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        to.write_bytes(self.content)
        return Completed(tuple(argv), 0, b"", b"")

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        return Completed(tuple(argv), self.code, self.content, self.stderr)


def header(name: bytes, size: bytes, kind: bytes, prefix: bytes = b"", *, magic: bytes = b"ustar\x0000") -> bytes:
    """Return a tar header with these fields (POSIX.1-2017, ustar) and a correct checksum."""
    block = bytearray(512)
    block[0:100] = name[:100].ljust(100, b"\0")
    block[100:124] = b"0000644\0" + b"0000000\0" * 2
    block[124:136] = size
    block[136:148] = b"00000000000\0"
    block[156:157] = kind
    block[257:265] = magic
    block[345:500] = prefix[:155].ljust(155, b"\0")
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


def entry(name: bytes, content: bytes, kind: bytes = b"0") -> bytes:
    return header(name, b"%011o\0" % len(content), kind) + content + bytes(-len(content) % 512)


ENTRIES = st.builds(
    lambda name, size, kind, prefix, content: header(name, size, kind, prefix) + content,
    NAMES.map(str.encode),
    FIELD,
    st.sampled_from([b"0", b"\0", b"1", b"2", b"3", b"5", b"6", b"7", b"L", b"K", b"S", b"x", b"g", b"\xff"]),
    st.just(b"") | st.binary(max_size=155),
    st.binary(max_size=1100),
)
COMPLETE_ENTRIES = st.builds(entry, NAMES.map(str.encode), st.binary(max_size=1100))


def is_printable(error: FieldkitError) -> bool:
    return str(error).replace("\n  remedy: ", "").isprintable()


def fetch_archive(content: bytes) -> dict[str, bytes] | None:
    """Return the files that a fetch accepted, or None after an error. Other effects and errors are failures."""
    with tempfile.TemporaryDirectory() as folder:
        into = Path(folder, "outer", "into")
        into.mkdir(parents=True)
        raised_error: FieldkitError | None = None
        try:
            fetching.fetch(AnsweringRobot(Path(folder), content), "x", "sender", "lo", into)
        except FieldkitError as error:
            raised_error = error
        assert raised_error is None or is_printable(raised_error)
        assert [path.name for path in Path(folder).iterdir()] == ["outer"]
        assert [path.name for path in Path(folder, "outer").iterdir()] == ["into"]
        paths = list(into.rglob("*"))
        assert not [path for path in paths if path.is_symlink() or not (path.is_file() or path.is_dir())]
        assert not [path for path in paths if path.name.startswith(".")]
        files = {str(path.relative_to(into)): path.read_bytes() for path in paths if path.is_file()}
        return files if raised_error is None else None


@given(st.lists(ENTRIES | COMPLETE_ENTRIES, max_size=5), st.binary(max_size=30))
def test_any_archive_stays_in_its_folder(entries: list[bytes], tail: bytes) -> None:
    fetch_archive(b"".join(entries) + tail)
    fetch_archive(b"".join(entries) + bytes(1024))


@given(st.dictionaries(st.sampled_from(["scan.bag", "scan/a.db3", "b"]), st.binary(max_size=3000)), st.data())
def test_archive_is_accepted_completely_or_rejected(files: dict[str, bytes], data: st.DataObject) -> None:
    sums = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items())
    members = [(".sums-1", sums.encode()), *files.items()]
    archive = b"".join(entry(name.encode(), content) for name, content in members) + bytes(1024)
    if files:
        with tempfile.TemporaryDirectory() as folder:
            fetching.fetch(AnsweringRobot(Path(folder), archive), "x", "sender", "lo", Path(folder))
            assert {name: Path(folder, name).read_bytes() for name in files} == files
    damaged = bytearray(archive)
    position = data.draw(st.integers(0, len(archive) - 1))
    damaged[position] ^= data.draw(st.integers(1, 255))
    for damaged_archive in (bytes(damaged), archive[:position]):
        assert fetch_archive(damaged_archive) in (None, files)


@pytest.mark.parametrize("kind", [tarfile.GNU_FORMAT, tarfile.USTAR_FORMAT, tarfile.PAX_FORMAT])
def test_archives_of_another_tar_writer_are_read(kind: int, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=kind) as tar:
        for name, content in (("scan.bag", b"x" * 700), ("scan/a.db3", b"")):
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    buffer.seek(0)
    members_read = [(member.name, b"".join(member.chunks)) for member in archive.members(buffer, "robot")]
    assert members_read == [("scan.bag", b"x" * 700), ("scan/a.db3", b"")]


@pytest.mark.parametrize(
    "content",
    [
        entry(b"0" * 64 + b"  scan.bag", b""),
        header(b"scan.bag", b"77777777777\0", b"0") + bytes(512),
        header(b"scan.bag", b"\x80" + b"\xff" * 11, b"0"),
        header(b"scan.bag", b"-0000000001\0", b"0"),
        b"".join(entry(b"f%d" % number, b"") for number in range(archive.MAX_FILES + 1)) + bytes(1024),
        entry(b"././@PaxHeader", b"30 path=/etc/evil\n", b"x") + entry(b"scan.bag", b""),
        entry(b"scan.bag", b"x") + entry(b"scan.bag", b"y") + bytes(1024),
        entry(b".sums-1", b"") + entry(b".sums-2", b"") + bytes(1024),
        entry(b"a" * 49, b"") + bytes(1024),
    ],
    ids=["spaces", "huge", "base-256", "negative", "many", "pax", "twice", "two sums", "long"],
)
def test_invalid_archives_are_rejected(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(EvidenceError):
        fetching.fetch(AnsweringRobot(tmp_path, content), "x", "sender", "lo", tmp_path)


def test_files_of_another_robot_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "scan.bag").write_bytes(b"x")
    sums = hashlib.sha256(b"y").hexdigest().encode() + b"  scan.bag\n"
    content = entry(b".sums-1", sums) + entry(b"scan.bag", b"y") + bytes(1024)
    with pytest.raises(EvidenceError, match="which it or another robot sent before"):
        fetching.fetch(AnsweringRobot(tmp_path, content), "x", "sender", "lo", tmp_path)
    assert (tmp_path / "scan.bag").read_bytes() == b"x"


def test_damaged_header_is_reported(tmp_path: Path) -> None:
    content = bytearray(entry(b"scan.bag", b"y") + bytes(1024))
    content[0] ^= 1
    with pytest.raises(EvidenceError, match="arrived damaged: a header fails its checksum"):
        fetching.fetch(AnsweringRobot(tmp_path, bytes(content)), "x", "sender", "lo", tmp_path)


@given(BYTES)
def test_output_of_a_robot_is_shown_as_a_printable_line(data: bytes) -> None:
    text = printable(data, limit=60)
    assert len(text) <= 60
    assert not [char for char in text if unicodedata.category(char) in {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}]


@given(BYTES, st.integers(0, 255), st.sampled_from([b"", b"job.sh: ", b"job.sh: held ", b"job.sh: aborted 1 "]))
def test_any_answer_of_the_script_raises_an_error_of_fieldkit(output: bytes, code: int, start: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        shell = AnsweringRobot(Path(folder), output, code=code, stderr=start + output)
        raised_error: FieldkitError | None = None
        try:
            script.call(shell, "left", deadline=Deadline.after(1))
        except FieldkitError as error:
            raised_error = error
        assert raised_error is None if code == 0 else raised_error is not None and is_printable(raised_error)
        if code == 0:
            assert all(line.isprintable() for line in jobs.list_running(shell, Deadline.after(1)))


@pytest.mark.parametrize(
    ("code", "stderr", "kind"),
    [
        (75, b"job.sh: held 99999999999 99999999999 99999999999 \x1b[2J x", RobotError),
        (76, b"job.sh: aborted 99999999999 \xe2\x80\xae x", LockLostError),
        (76, b"job.sh: gone 0 - -", LockLostError),
        (76, b"job.sh: nonsense", RobotError),
        (76, b"", RobotError),
    ],
)
def test_any_lock_message_of_a_robot_is_reported(
    code: int, stderr: bytes, kind: type[RobotError], tmp_path: Path
) -> None:
    with pytest.raises(kind) as error_info:
        script.call(AnsweringRobot(tmp_path, code=code, stderr=stderr), "begin", deadline=Deadline.after(1))
    assert error_info.value.what.isprintable()


WORDS = st.lists(TEXT.filter(lambda text: "\0" not in text), max_size=5)


@settings(max_examples=40)
@given(WORDS, st.sampled_from(["sh", "bash", "busybox"]))
def test_any_argument_arrives_through_any_shell(arguments: list[str], shell: str) -> None:
    argv = (shell, "sh", "-c") if shell == "busybox" else (shell, "-c")
    completed = subprocess.run((*argv, quote(("printf", "%s\\0", *arguments))), stdout=subprocess.PIPE, check=True)
    assert completed.stdout.decode("utf-8", "surrogateescape").split("\0")[:-1] == (arguments or [""])


def is_visible(char: str) -> bool:
    """Return True if a character is visible: all Unicode categories except other and separator (C, Z)."""
    return char in {" ", "\N{NO-BREAK SPACE}"} or unicodedata.category(char)[0] not in "CZ"


@given(TEXT)
def test_reason_is_a_single_cell_and_a_single_line(reason: str) -> None:
    table = rows.to_csv([RepeatRow(reason=reason or None)], trial_columns())
    assert len(table.splitlines()) == 2
    header_cells, cells = csv.reader(io.StringIO(table, newline=""))
    expected = "".join(char if is_visible(char) else "?" for char in " ".join(reason.splitlines()))
    assert unescape_formula(cells[header_cells.index("reason")]) == expected
    del cells[header_cells.index("reason")]
    assert not any(cells)


@given(TEXT)
def test_events_write_only_printable_characters_to_the_terminal(text: str) -> None:
    events: list[Event] = [
        Note(text),
        RepeatEnded("udp-01", 1, Status.VOID, reason=text, summary=text, done=1, total=2, left_s=1),
    ]
    for event in events:
        text_of_event = display.event_text(event)
        assert text_of_event is not None
        assert text_of_event.plain.replace("\n", "").replace("\N{NO-BREAK SPACE}", "").isprintable()


@pytest.mark.parametrize("show", [display.show_error, lambda text: display.print_table(["x"], [[text]])])
def test_errors_and_tables_show_markup_and_escapes_literally(
    show: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    show("[bold]a[/bold] \x1b]52;c;QQ==\x07 \u202e b")
    output = "".join(capsys.readouterr())
    assert "[bold]a[/bold] ?]52;c;QQ==" in output
    assert not set(output) & set("\x1b\x07\u202e")


class EndlessChannel:
    """A channel whose sender never pauses."""

    eof_received = closed = False
    read_bytes = 0

    def recv_ready(self) -> bool:
        assert self.read_bytes < 1 << 30, "reading does not stop"
        return True

    def recv(self, size: int) -> bytes:
        self.read_bytes += size
        return bytes(size)

    def send_ready(self) -> bool:
        return False

    def recv_stderr_ready(self) -> bool:
        return False

    def fileno(self) -> int:
        return sys.stderr.fileno()


def test_output_without_end_or_pause_is_limited() -> None:
    channel, out = EndlessChannel(), io.BytesIO()
    with pytest.raises(RobotError, match="sent more than 1000000 bytes"):
        drain(channel, out, stdin=b"x", deadline=Deadline.after(30), limit_bytes=10**6, robot="r")  # type: ignore[arg-type]
    assert channel.read_bytes < 1.1e6


def test_list_of_hashes_of_any_size_needs_little_memory(tmp_path: Path) -> None:
    size = 100 << 20

    class LargeAnswer(LocalShell):
        def fetch(self, argv: object, to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
            with to.open("wb") as file:
                file.write(header(b".sums-1", f"{size:011o}".encode() + b"\0", b"0"))
                file.truncate(512 + size + 1024)
            return Completed((), 0, b"", b"")

    tracemalloc.start()
    try:
        with pytest.raises(EvidenceError):
            fetching.fetch(LargeAnswer(tmp_path), "f", "sender", "lo", tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
    finally:
        tracemalloc.stop()
