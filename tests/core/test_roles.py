import copy
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import FIXED_ROLES, Role, in_order


@given(st.from_regex(Role.PATTERN, fullmatch=True))
def test_a_role_is_one_object_however_it_is_made(name: str) -> None:
    role = Role(name)
    assert role == name
    assert Role(str(role)) is role
    assert copy.deepcopy(role) is role
    assert pickle.loads(pickle.dumps(role)) is role


@pytest.mark.parametrize("name", ["", "Rival", "1st", "a-b", "a.b", "a/b", "x" * 32, "a\n"])
def test_what_cannot_be_part_of_a_file_s_name_is_no_role(name: str) -> None:
    with pytest.raises(ValueError, match="a role is named by"):
        Role(name)


def test_a_lab_s_own_come_behind_the_fixed_ones() -> None:
    own = [Role("a"), Role("z")]
    assert in_order([own[1], *reversed(FIXED_ROLES), own[0]]) == [*FIXED_ROLES, *own]
