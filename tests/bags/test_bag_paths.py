"""Bags can be read at any path, whatever bytes it has, and written at any path of characters."""

import os
import shutil
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.bags import contents
from fieldkit.bags.formats import BagFormat
from fieldkit.measure.evidence import bag
from tests.bags.test_bag_command import data_file, expected, written

COUNT = 9
NAMES = st.binary(min_size=1, max_size=40).filter(
    lambda name: not set(name) & set(b"/\0") and name not in {b".", b".."}
)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[BagFormat, Path]:
    return {form: written(tmp_path_factory.mktemp(form.value), form, expected(COUNT)) for form in BagFormat}


@pytest.mark.parametrize("form", BagFormat)
@given(name=NAMES)
@example(b"#1")
@example(b"what?")
@example(b"a?mode=memory")
@example(b"100%")
@example(b"%41%00")
@example(b"caf\xe9")
@example("日本 #?".encode())
@example(b"two\nlines")
def test_a_bag_is_read_at_any_path(
    bags: dict[BagFormat, Path], tmp_path_factory: pytest.TempPathFactory, form: BagFormat, name: bytes
) -> None:
    base = tmp_path_factory.mktemp("any")
    folder = base / os.fsdecode(name)
    folder.mkdir()
    try:
        lies_at = folder / bags[form].name
        if bags[form].is_dir():
            shutil.copytree(bags[form], lies_at)
        else:
            shutil.copy(bags[form], lies_at)
        found = contents.inspect(lies_at, read_all=True)
        assert (found.problems, found.messages) == ((), COUNT)
        assert bag.read(data_file(lies_at)).messages == COUNT, "as the evidence of a repeat"
    finally:
        shutil.rmtree(base)


@pytest.mark.parametrize("name", ["#1", "what?", "100%", "%41", "a?mode=memory", "日本"])
def test_a_bag_is_written_at_any_path(bags: dict[BagFormat, Path], tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    contents.convert(bags[BagFormat.MCAP], tmp_path / name / name, storage=BagFormat.SQLITE)
    contents.repair(tmp_path / name / name, tmp_path / name / "again")
    for made in (name, "again"):
        found = contents.inspect(tmp_path / name / made, read_all=True)
        assert (found.problems, found.messages) == ((), COUNT)
        assert data_file(tmp_path / name / made).name == f"{made}.db3"
    assert {path.name for path in tmp_path.iterdir()} == {name}
