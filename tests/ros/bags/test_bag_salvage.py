"""Recovery of bags: for hostile bytes, the only possible results are messages and `DamagedError`."""

import random
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.ros.bags import salvage
from fieldkit.ros.bags.formats import BagFormat
from fieldkit.ros.bags.salvage import DamagedError
from tests.ros.bags.test_bag_command import KILLED, data_file, expected, write_bag

COMPLETE_BAG = (KILLED / "open.bag.active").read_bytes()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[BagFormat, bytes]:
    return {
        form: data_file(write_bag(tmp_path_factory.mktemp(form.value), form, expected(20))).read_bytes()
        for form in BagFormat
    }


@pytest.mark.parametrize("form", BagFormat)
@given(seed=st.integers(0, 1 << 32), flips=st.integers(0, 8))
@example(seed=290, flips=4)  # a record inside a chunk states an impossible length
def test_changed_bytes_give_messages_or_an_error(
    tmp_path_factory: pytest.TempPathFactory, files: dict[BagFormat, bytes], form: BagFormat, seed: int, flips: int
) -> None:
    draw = random.Random(seed)
    data = bytearray(files[form])
    for _ in range(flips):
        data[draw.randrange(len(data))] = draw.randrange(256)
    file = tmp_path_factory.getbasetemp() / f"changed-{form.value}"
    file.write_bytes(data[: draw.randrange(len(data)) if flips % 2 else None])
    with suppress(DamagedError):
        assert sum(1 for _ in salvage.messages(form, file)) <= 20 or flips


def test_a_table_of_topics_without_a_needed_column_is_damaged(tmp_path: Path) -> None:
    bag = data_file(write_bag(tmp_path / "bag", BagFormat.SQLITE, expected(3)))
    with closing(sqlite3.connect(bag)) as database, database:
        database.execute("ALTER TABLE topics RENAME COLUMN id TO ie")
    with pytest.raises(DamagedError, match="the table topics has no id"):
        list(salvage.messages(BagFormat.SQLITE, bag))


def test_a_record_longer_than_an_integer_of_the_platform_is_damaged(tmp_path: Path) -> None:
    bag = data_file(write_bag(tmp_path / "bag", BagFormat.MCAP, expected(3)))
    data = bytearray(bag.read_bytes())
    data[9:17] = b"\xff" * 8  # the length of the first record, after the magic and the opcode
    bag.write_bytes(data)
    with pytest.raises(DamagedError):
        list(salvage.messages(BagFormat.MCAP, bag))


@given(st.integers(13, len(COMPLETE_BAG)))
def test_longer_file_recovers_no_less(tmp_path_factory: pytest.TempPathFactory, length: int) -> None:
    def count_recovered(data: bytes) -> int:
        file: Path = tmp_path_factory.getbasetemp() / "cut.bag"
        file.write_bytes(data)
        count = 0
        try:
            for _ in salvage.messages(BagFormat.ROS1, file):
                count += 1
        except DamagedError:
            return count
        return count

    assert count_recovered(COMPLETE_BAG[: length // 2]) <= count_recovered(COMPLETE_BAG[:length]) <= 266
