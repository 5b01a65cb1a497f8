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
    """Return a lab with a folder of procedures, which is the current directory."""
    folder = tmp_path / "lab"
    (folder / "procedures").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def load_program(name: str, source: str = "procedures/p.yaml") -> LabProgram:
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
    program = load_program("tools/probe")
    assert program == LabProgram(
        file="tools/probe", sha256=hashlib.sha256(SCRIPT).hexdigest(), size_bytes=len(SCRIPT), executable=executable
    )
    assert (program.name, program.content()) == ("probe", SCRIPT)


def test_stored_program_is_parsed_without_a_search() -> None:
    write_program("tools/probe")
    stored_text = schema.dump(Holder(put=load_program("tools/probe")))
    Path("tools/probe").unlink()
    assert schema.dump(schema.validate(schema.parse(stored_text, source="trial.yaml"), Holder)) == stored_text


def test_folder_of_the_procedure_takes_precedence_over_that_of_the_lab(tmp_path: Path) -> None:
    write_program("probe")
    assert load_program("probe").file == "probe"
    write_program("procedures/probe", b"other")
    assert (load_program("probe").file, load_program("probe").content()) == ("procedures/probe", b"other")
    write_program(str(tmp_path / "elsewhere" / "probe"), b"third")
    assert load_program("probe", str(tmp_path / "elsewhere" / "p.yaml")).content() == b"third"


def test_a_link_inside_of_the_lab_is_followed() -> None:
    write_program("tools/probe")
    Path("procedures/probe").symlink_to("../tools/probe")
    assert load_program("probe").file == "tools/probe"


@pytest.mark.parametrize(
    ("name", "create_file", "message"),
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
def test_invalid_program_is_rejected_with_its_line(name: str, create_file: Callable[[], None], message: str) -> None:
    create_file()
    with pytest.raises(ConfigurationError, match=message) as error_info:
        load_program(name)
    assert error_info.value.where == "procedures/p.yaml:2"


def test_program_of_the_maximum_size_is_accepted() -> None:
    write_program("large", bytes(program_files.MAX_BYTES))
    assert load_program("large").size_bytes == program_files.MAX_BYTES


def test_changed_or_missing_program_is_rejected() -> None:
    write_program("probe")
    program = load_program("probe")
    write_program("probe", SCRIPT + b"#")
    with pytest.raises(ConfigurationError, match="has changed since the procedure was read") as error_info:
        program.content()
    assert error_info.value.where == "probe"
    assert program.sha256 in error_info.value.remedy
    Path("probe").unlink()
    with pytest.raises(ConfigurationError, match="cannot be read: No such file"):
        program.content()
