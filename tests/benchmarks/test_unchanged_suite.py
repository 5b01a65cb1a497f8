"""Comparison of the tests of two commits: names, imports, labels and files may change, checks may not."""

from pathlib import Path

import pytest

from benchmarks.unchanged import suite

BEFORE = '''\
"""What is told."""

import pytest

from fieldkit.core import units

TOLD_S = 30


@pytest.mark.parametrize("found", [1, 2])
def test_who_tells(found: int) -> None:
    """Of each one."""
    from fieldkit.core.text import said
    shown = units.parse("30ft", found)
    assert shown.told == said(found), "is none"
    with pytest.raises(ValueError, match="so long"):
        units.parse("", 2.5)


def test_two() -> None:
    one, other = 1, 2
    assert one < other
'''

RENAMED = '''\
"""Reports."""

import pytest

from fieldkit.core.quantities import parse_quantity

REPORT_S = 30


@pytest.mark.parametrize("value", [1, 2])
def test_reports(value):
    from fieldkit.core.wording import report_text
    printed = parse_quantity("30ft", value)
    assert printed.report == report_text(value), "is not a report"
    with pytest.raises(ValueError, match="that long"):
        parse_quantity("", 2.5)


def test_order() -> None:
    """Two numbers."""
    least, most = 1, 2
    assert least < most
'''


def compare_versions(tmp_path: Path, after: str, name: str = "test_a.py", before: str = BEFORE) -> suite.Changes:
    for folder, file, text in (("before", "test_a.py", before), ("after", name, after)):
        path = tmp_path / folder / file
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
    return suite.compare(tmp_path / "before", tmp_path / "after")


@pytest.mark.parametrize("name", ["test_a.py", "motion/test_b.py"])
def test_names_imports_labels_and_files_may_change(tmp_path: Path, name: str) -> None:
    result = compare_versions(tmp_path, RENAMED, name)
    assert (result.has_differences, result.same, list(result.lines())) == (False, 2, [])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("assert one < other", "assert one <= other", "assertion: test_a.py::test_two: line 22: assert one < other"),
        ("assert one < other", "assert one < one", "assertion: test_a.py::test_two: line 22: assert one < other"),
        ("    assert one < other", "    assert other", "assertion: test_a.py::test_two: line 22: assert one < other"),
        (
            "shown.told ==",
            "shown ==",
            "assertion: test_a.py::test_who_tells: line 15: assert shown.told == said(found)",
        ),
        ("raises(ValueError, ", "raises(", "assertion: test_a.py::test_who_tells: line 16: pytest.raises(ValueError"),
        ("one, other = 1, 2", "one, other = 1, 3", "body: test_a.py::test_two: numbers ['2'] -> ['3']"),
        ('"30ft"', '"35ft"', "body: test_a.py::test_who_tells: numbers ['30'] -> ['35']"),
        ("[1, 2])", "[1])", "body: test_a.py::test_who_tells: numbers ['2'] -> []"),
        ("@pytest", "@pytest.mark.skip\n@pytest", "body: test_a.py::test_who_tells: other statements"),
        ("TOLD_S = 30", "TOLD_S = 31", "body: test_a.py::(statements): numbers ['30'] -> ['31']"),
        ("def test_two", "def two", "removed: test_a.py::test_two"),
        ("test_two() -> None:\n", "test_two() -> None:\n    return\n", "body: test_a.py::test_two: other statements"),
    ],
)
def test_a_changed_check_is_listed(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in BEFORE
    result = compare_versions(tmp_path, BEFORE.replace(old, new, 1))
    assert result.has_differences
    assert any(line.startswith(expected) for line in result.lines()), list(result.lines())


def test_removed_copy_is_the_one_that_is_listed(tmp_path: Path) -> None:
    copy = "def test_copy() -> None:\n    one, other = 1, 2\n    assert one < other\n"
    result = compare_versions(tmp_path, BEFORE, before=f"{BEFORE}\n\n{copy}")
    assert list(result.lines()) == ["removed: test_a.py::test_copy"]
    assert compare_versions(tmp_path / "added", f"{BEFORE}\n\n{copy}").added == 1
