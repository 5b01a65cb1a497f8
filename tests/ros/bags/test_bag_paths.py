"""Bags can be read at any path, also with invalid characters, and written to any path with valid characters."""

import os
import shutil
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.ros.bags import bag, contents, formats
from fieldkit.ros.bags.formats import BagFormat
from tests.ros.bags.test_bag_command import data_file, expected, write_bag

COUNT = 9
NAMES = st.binary(min_size=1, max_size=40).filter(
    lambda name: not set(name) & set(b"/\0") and name not in {b".", b".."}
)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[BagFormat, Path]:
    return {form: write_bag(tmp_path_factory.mktemp(form.value), form, expected(COUNT)) for form in BagFormat}


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
def test_bag_is_read_at_any_path(
    bags: dict[BagFormat, Path], tmp_path_factory: pytest.TempPathFactory, form: BagFormat, name: bytes
) -> None:
    base = tmp_path_factory.mktemp("any")
    folder = base / os.fsdecode(name)
    folder.mkdir()
    try:
        bag_path = folder / bags[form].name
        if bags[form].is_dir():
            shutil.copytree(bags[form], bag_path)
        else:
            shutil.copy(bags[form], bag_path)
        contents_of_bag = contents.inspect(bag_path, read_all=True)
        assert (contents_of_bag.problems, contents_of_bag.messages) == ((), COUNT)
        assert bag.read(data_file(bag_path)).messages == COUNT, "the evidence of a repeat is read with this function"
    finally:
        shutil.rmtree(base)


@pytest.mark.parametrize("name", ["#1", "what?", "100%", "%41", "a?mode=memory", "日本"])
def test_bag_is_written_at_any_path(bags: dict[BagFormat, Path], tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    contents.convert(bags[BagFormat.MCAP], tmp_path / name / name, storage=BagFormat.SQLITE)
    contents.repair(tmp_path / name / name, tmp_path / name / "again")
    for name_of_bag in (name, "again"):
        contents_of_bag = contents.inspect(tmp_path / name / name_of_bag, read_all=True)
        assert (contents_of_bag.problems, contents_of_bag.messages) == ((), COUNT)
        assert data_file(tmp_path / name / name_of_bag).name == f"{name_of_bag}.db3"
    assert {path.name for path in tmp_path.iterdir()} == {name}


def test_data_files_are_in_the_order_of_their_numbers(bags: dict[BagFormat, Path], tmp_path: Path) -> None:
    names = [f"run_{number}.mcap" for number in range(12)]
    for name in names:
        shutil.copy(data_file(bags[BagFormat.MCAP]), tmp_path / name)
    (tmp_path / "metadata.yaml").write_text("")
    assert [file.name for file in formats.find(tmp_path).files] == names
