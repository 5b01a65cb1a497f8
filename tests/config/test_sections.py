"""Sections that installed packages add to profiles: parsing, dumping, absent sections, and invalid classes."""

from collections.abc import Mapping
from functools import partial
from importlib.metadata import EntryPoint

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.config import documents, schema
from fieldkit.config.profiles import ProfileSection, RobotProfile
from fieldkit.config.schema import Int
from fieldkit.config.sections import load_model
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.lazy_mapping import LazyMapping
from tests.helpers.paths import ROOT

SHIPPED = documents.read(ROOT / "robots" / "iris.yaml").data
PROFILE = {key: value for key, value in SHIPPED.items() if key not in {"drive", "mavlink"}}


class Winch(ProfileSection):
    """Section of a package that is not installed here."""

    permission = "winch"

    metres: Int

    def contradiction(self, profile: RobotProfile) -> str | None:
        return None if self.metres else f"the winch of {profile.name} has no rope"


def entry_point(target: str) -> EntryPoint:
    return EntryPoint("winch", f"{__name__}:{target}", "bench")


class BenchProfile(RobotProfile):
    """A profile if the package of `Winch` is installed."""

    @classmethod
    def section_types(cls) -> Mapping[str, type[schema.BaseModel]]:
        return LazyMapping({"winch": entry_point("Winch")}, partial(load_model, ProfileSection))


def load_profile(winch: object) -> BenchProfile:
    text = documents.to_text({**PROFILE, "winch": winch})
    return schema.validate(schema.parse(text, source="robots/iris.yaml"), BenchProfile)


def test_a_section_is_read_and_written_like_a_key_of_the_profile() -> None:
    profile = load_profile({"metres": 3})
    assert profile.section("winch", Winch) == Winch(metres=3)
    assert dict(profile.sections) == {"winch": Winch(metres=3)}
    assert profile.model_dump(mode="json")["winch"] == {"metres": 3}
    assert schema.validate(schema.parse(schema.dump(profile), source="x.yaml"), BenchProfile) == profile
    assert profile != load_profile({"metres": 4})


def test_a_section_without_a_value_is_absent() -> None:
    assert not load_profile(None).sections
    assert load_profile(None).section("winch", Winch) is None
    assert "winch" not in load_profile(None).model_dump()


@pytest.mark.parametrize(
    ("winch", "message"),
    [
        ({"metres": "3"}, "in winch.metres: "),
        ({"meters": 3}, "in winch: unknown key meters; did you mean 'metres'?"),
        ({"metres": 0}, "the winch of iris has no rope"),
        ([], "in winch: "),
    ],
)
def test_an_error_in_a_section_names_its_place(winch: object, message: str) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        load_profile(winch)
    assert error_info.value.what.startswith(message)
    assert error_info.value.where.startswith("robots/iris.yaml:")


def test_an_error_in_a_section_hides_no_other_error() -> None:
    invalid_profile = {**PROFILE, "winch": {"metres": "3"}, "limits": {"max_speed_m_s": "fast"}}
    with pytest.raises(ConfigurationError) as error_info:
        schema.validate(schema.parse(documents.to_text(invalid_profile), source="robots/iris.yaml"), BenchProfile)
    assert error_info.value.what.startswith("in limits.max_speed_m_s: "), "the first error in the file"
    assert error_info.value.what.endswith(" (and 1 more problem)")


def test_a_key_without_an_installed_package_is_unknown() -> None:
    document = schema.parse(documents.to_text({**PROFILE, "winch": {"metres": 3}}), source="robots/iris.yaml")
    with pytest.raises(ConfigurationError, match="unknown key winch"):
        schema.validate(document, RobotProfile)


def test_an_entry_point_must_name_a_section() -> None:
    with pytest.raises(ConfigurationError, match="a section must be a subclass of ProfileSection") as error_info:
        load_model(ProfileSection, entry_point("RobotProfile"))
    assert error_info.value.where == f"entry point winch = {__name__}:RobotProfile"


@pytest.mark.parametrize(
    ("keys", "abilities"),
    [
        ({}, set()),
        ({"drives": True}, {"drive"}),
        ({"flies": True, "drives": False}, {"mavlink"}),
        ({"abilities": ["mavlink", "drive"]}, {"drive", "mavlink"}),
    ],
)
def test_abilities_in_plans_are_also_read_from_former_keys(keys: dict[str, object], abilities: set[str]) -> None:
    robot = Robot.model_validate({"name": "r", "address": "10.0.0.1", "profile": PROFILE, **keys})
    assert robot.abilities == abilities
    assert robot.model_dump(mode="json").get("abilities", []) == sorted(abilities)
