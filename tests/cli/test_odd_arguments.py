"""Command lines with odd values: the right exit code and a message about the cause, and no traceback."""

from pathlib import Path

import pytest

from fieldkit.core import files
from tests.helpers import texts
from tests.helpers.runs import run_here
from tests.helpers.tables import COMPARABLE, repeats, replace, write


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("lab", "plot", "--robots", "1_0"), "'1_0' is not a whole number"),
        (("lab", "plot", "--robots", "\N{ARABIC-INDIC DIGIT THREE}"), "is not a whole number"),
        (("lab", "plot", "--robots", "1" + 9 * "0"), "--robots: a lab has at most 10000 robots"),
        (("lab", "plot", "--robots", "0"), "--robots: a lab has at least one robot"),
        (("lab", "plot", "--profile", "husky"), "--profile is the profile of the robots of --robots"),
        (("lab", "plot", "--backend", ""), "there is no backend ''"),
        (("trial", "los", "30ft", "--dry-run", "--backend", ""), "there is no backend ''"),
        (("trial", "los", "30ft", "--dry-run", "--junit", "."), "'.' is a folder, not a file"),
        (("lab", "up", "--seed", "-1"), "'-1' is not a whole number"),
        (("cosim", "conform", "carts", "--windows", "0"), "must be at least 1"),
        (("middleware", "recommend", ".", "-o", "out", "--repeats", "1_0"), "'1_0' is not a whole number"),
        (("lab", "plot", "--robots", "1", "-o", "none/lab.svg"), "none/lab.svg: No such file or directory"),
    ],
)
def test_odd_values_are_errors(tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    run = run_here(tmp_path, *words)
    assert (run.code, message in run.err) == (2, True), run.err


def test_options_may_be_between_words(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / name, [replace(COMPARABLE, trial=name)])
    after_options = run_here(tmp_path, "aggregate", "a", "b", "--by", "trial", "--format", "csv")
    assert after_options.code == 0, after_options.err
    assert run_here(tmp_path, "aggregate", "a", "--by", "trial", "b", "--format", "csv") == after_options
    assert run_here(tmp_path, "compare", "a", "--force", "b").code == 0
    assert run_here(tmp_path, "trial", "los", "30ft", "--dry-run", "40ft").code == 0
    assert "unknown unit 'kg'" in run_here(tmp_path, "trial", "los", "30ft", "--dry-run", "40kg").err
    unknown = run_here(tmp_path, "aggregate", "a", "--by", "trial", "b", "--bye", "x")
    assert "no option or argument '--bye'" in unknown.err


def test_a_file_of_emulated_robots_without_a_backend_has_both_remedies(tmp_path: Path) -> None:
    site = texts.site(emulated="ros: builtin").replace("backend: emulated\n", "")
    (tmp_path / "fieldkit.yaml").write_text(site, encoding="utf-8")
    run = run_here(tmp_path, "trial", "los", "30ft", "--dry-run", "--topology", "masterless")
    assert (run.code, "add host: to it; or, for emulated robots, write backend: emulated" in run.err) == (2, True)


def test_a_path_that_cannot_contain_a_recording_has_the_error_of_the_path(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "broken" / "run.json").mkdir(parents=True)
    for name, message in (("file", "there is no recording"), ("broken", "cannot be read: Is a directory")):
        run = run_here(tmp_path, "cosim", "replay", name)
        assert (run.code, message in run.err) == (4, True), run.err


def test_a_tiny_width_has_a_finite_number_of_repeats(tmp_path: Path) -> None:
    write(tmp_path / "a", repeats(COMPARABLE, 8))
    run = run_here(tmp_path, "aggregate", "a", "--width", "0.0000000001%", "--quantity", "ip_loss", "--format", "csv")
    assert run.code == 0, run.err
    assert 1e15 < int(run.out.splitlines()[1].rpartition(",")[2]) < 1e25


def test_an_error_of_a_trial_is_not_an_error_of_the_written_file(tmp_path: Path) -> None:
    write(tmp_path / "a", [COMPARABLE])
    (tmp_path / "loop").symlink_to("loop")
    exported = run_here(tmp_path, "export", ".", "--format", "csv", "-o", "table.csv")
    assert (exported.code, "table.csv" in exported.err) == (2, False), exported.err
    assert not (tmp_path / "table.csv").exists()


def test_a_file_that_cannot_be_replaced_is_named_in_the_error(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "none" / "file", tmp_path / "folder"):
        with pytest.raises(OSError, match=r"No such file|Is a directory") as error:
            files.write(path, b"")
        assert error.value.filename == str(path)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
