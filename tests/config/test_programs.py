"""Programs of the lab in procedures: search path, rejected files, and the values stored in a plan."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.config import program_files, schema
from fieldkit.config.named_programs import NamedProgram
from fieldkit.config.program_files import LabProgram
from fieldkit.config.schema import Strict
from fieldkit.core.errors import ConfigurationError

SCRIPT = b"#!/bin/sh\necho 1\n"


class Holder(Strict):
    put: NamedProgram | None = None


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A lab with a folder of procedures as the current directory."""
    folder = tmp_path / "lab"
    (folder / "procedures").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def put(name: str, source: str = "procedures/p.yaml") -> LabProgram:
    value = schema.validate(schema.parse(f"# a comment\nput: {name}", source=source), Holder).put
    assert value is not None
    return value


def write_program(path: str, content: bytes = SCRIPT, mode: int = 0o644) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(content)
    Path(path).chmod(mode)


@pytest.mark.parametrize(("mode", "executable"), [(0o755, True), (0o744, True), (0o644, False)])
def test_plan_stores_hash_size_and_executable_flag(mode: int, executable: bool) -> None:
    write_program("tools/probe", mode=mode)
    program = put("tools/probe")
    assert program == LabProgram(
        file="tools/probe", sha256=hashlib.sha256(SCRIPT).hexdigest(), size_bytes=len(SCRIPT), executable=executable
    )
    assert (program.name, program.content()) == ("probe", SCRIPT)


def test_stored_program_is_parsed_without_a_search() -> None:
    write_program("tools/probe")
    frozen = schema.dump(Holder(put=put("tools/probe")))
    Path("tools/probe").unlink()
    assert schema.dump(schema.validate(schema.parse(frozen, source="trial.yaml"), Holder)) == frozen


def test_folder_of_the_procedure_takes_precedence_over_that_of_the_lab(tmp_path: Path) -> None:
    write_program("probe")
    assert put("probe").file == "probe"
    write_program("procedures/probe", b"other")
    assert (put("probe").file, put("probe").content()) == ("procedures/probe", b"other")
    write_program(str(tmp_path / "elsewhere" / "probe"), b"third")
    assert put("probe", str(tmp_path / "elsewhere" / "p.yaml")).content() == b"third"


def test_a_link_inside_of_the_lab_is_followed() -> None:
    write_program("tools/probe")
    Path("procedures/probe").symlink_to("../tools/probe")
    assert put("probe").file == "tools/probe"


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("absent", lambda: None, "there is no file 'absent'; searched in .*procedures and .*lab"),
        ("/etc/passwd", lambda: None, "not the relative path"),
        ("../x", lambda: None, "not the relative path"),
        ("tools/../../x", lambda: None, "not the relative path"),
        ("''", lambda: None, "not the relative path"),
        ("5", lambda: None, "the path of a file is needed here"),
        ("[a]", lambda: None, "the path of a file is needed here"),
        ('"a\\u0007b"', lambda: None, "cannot be printed"),
        ("link", lambda: Path("link").symlink_to("/etc/passwd"), "is a link to a file outside of .*lab"),
        ("etc/passwd", lambda: Path("etc").symlink_to("/etc"), "is a link to a file outside of .*lab"),
        ("gone", lambda: Path("gone").symlink_to("nothing"), "cannot be read: No such file"),
        ("loop", lambda: Path("loop").symlink_to("loop"), "cannot be read: Too many levels"),
        ("procedures", lambda: None, "is a folder"),
        ("pipe", lambda: os.mkfifo("pipe"), "cannot be read: it is a pipe"),
        (
            "large",
            lambda: write_program("large", bytes(program_files.MAX_BYTES + 1)),
            "more than 8.4 MB; install it",
        ),
    ],
)
def test_invalid_program_is_rejected_with_its_line(name: str, make: Callable[[], None], message: str) -> None:
    make()
    with pytest.raises(ConfigurationError, match=message) as caught:
        put(name)
    assert caught.value.where == "procedures/p.yaml:2"


def test_program_of_the_maximum_size_is_accepted() -> None:
    write_program("large", bytes(program_files.MAX_BYTES))
    assert put("large").size_bytes == program_files.MAX_BYTES


def test_changed_or_missing_program_is_rejected() -> None:
    write_program("probe")
    program = put("probe")
    write_program("probe", SCRIPT + b"#")
    with pytest.raises(ConfigurationError, match="has changed since the procedure was read") as caught:
        program.content()
    assert caught.value.where == "probe"
    assert program.sha256 in caught.value.remedy
    Path("probe").unlink()
    with pytest.raises(ConfigurationError, match="cannot be read: No such file"):
        program.content()
