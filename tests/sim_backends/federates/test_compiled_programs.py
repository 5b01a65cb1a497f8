"""Programs that are compiled on first use."""

import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.compiling import CompiledProgram, cache_folder

INSTALL = "apt-get install g++ pkg-config"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def program(tmp_path: Path, text: str = "int main() { return 7; }\n", *packages: str) -> CompiledProgram:
    source = tmp_path / "seven.cc"
    source.write_text(text, encoding="utf-8")
    return CompiledProgram("seven", source, packages, INSTALL, flags=("-O0",))


def test_a_program_is_compiled_once_and_again_if_its_source_changes(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    seven = program(tmp_path)
    with ThreadPoolExecutor() as pool:  # processes that start together
        paths = set(pool.map(lambda _: seven.path(), range(3)))
    assert len(paths) == 1
    path = paths.pop()
    assert subprocess.run([path], check=False).returncode == 7
    assert (
        capfd.readouterr().err == "note: compiling seven; this takes about 30 s, once per version of its libraries\n"
    )
    assert path.parent == cache_folder() == tmp_path / "cache" / "fieldkit" / "programs"
    assert program(tmp_path, "int main() { return 8; }\n").path() != path
    assert capfd.readouterr().err.startswith("note: compiling")


def test_a_missing_library_is_reported_with_the_command_that_installs_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="seven needs the library no-such-library") as error_info:
        program(tmp_path, "int main() {}\n", "no-such-library").path()
    assert error_info.value.remedy == INSTALL


def test_an_error_of_the_compiler_is_shown_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"seven cannot be compiled:\n(.*\n)*.*nothing.* was not declared"):
        program(tmp_path, "int main() { return nothing; }\n").path()
    assert [path.suffix for path in cache_folder().iterdir()] == [".lock"]
