import copy
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import FIXED_ROLES, Role, sort_roles


@given(st.from_regex(Role.PATTERN, fullmatch=True))
def test_equal_names_give_the_same_role_object(name: str) -> None:
    role = Role(name)
    assert role == name
    assert Role(str(role)) is role
    assert copy.deepcopy(role) is role
    assert pickle.loads(pickle.dumps(role)) is role


@pytest.mark.parametrize("name", ["", "Rival", "1st", "a-b", "a.b", "a/b", "x" * 32, "a\n"])
def test_an_invalid_role_name_is_an_error(name: str) -> None:
    with pytest.raises(ValueError, match=r"the name of a role .* at most 31 characters"):
        Role(name)


def test_additional_roles_are_listed_after_the_fixed_ones() -> None:
    additional = [Role("a"), Role("z")]
    assert sort_roles([additional[1], *reversed(FIXED_ROLES), additional[0]]) == [*FIXED_ROLES, *additional]
