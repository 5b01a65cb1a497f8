"""Checks that an ordinary user can create namespaces, with other files than those of this machine."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.process import namespaces
from sim_backends.emulated.process.namespaces import IdRange

NUMBERS = st.integers(0, 2**32 - 1)
OWNERS = st.from_regex(r"[a-z0-9_][a-z0-9_-]{0,30}", fullmatch=True)


@given(st.lists(st.builds(IdRange, OWNERS, NUMBERS, NUMBERS)))
def test_written_id_ranges_can_be_read(ranges: list[IdRange]) -> None:
    text = "".join(f"{ids.owner}:{ids.first}:{ids.count}\n" for ids in ranges)
    assert namespaces.id_ranges(text) == ranges
    assert namespaces.id_ranges(text.rstrip("\n")) == ranges


@pytest.mark.parametrize("line", ["", "#", "ann", "ann:1", "ann:1:", ":1:2", "ann:-1:2", "ann:1:2:3", "ann:x:2"])
def test_malformed_lines_are_ignored(line: str) -> None:
    assert namespaces.id_ranges(f"{line}\nbob:5:6\n{line}") == [IdRange("bob", 5, 6)]


@pytest.mark.parametrize(
    ("name", "forbids", "allows"),
    [
        ("kernel.unprivileged_userns_clone", "0", "1"),
        ("kernel.apparmor_restrict_unprivileged_userns", "1", "0"),
        ("user.max_user_namespaces", "0", "10000"),
    ],
)
def test_a_forbidding_setting_is_reported_with_its_remedy(
    name: str, forbids: str, allows: str, tmp_path: Path
) -> None:
    path = tmp_path / name.replace(".", "/")
    path.parent.mkdir()
    path.write_text(f"{allows}\n", encoding="ascii")
    assert namespaces.forbidding_settings(tmp_path) == {}
    path.write_text(f"{forbids}\n", encoding="ascii")
    assert namespaces.forbidding_settings(tmp_path) == {f"{name} = {forbids}": f"sudo sysctl {name}={allows}"}
