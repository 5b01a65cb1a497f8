"""The JSON schema of scenario files, with a validator that is independent of the models."""

from typing import Any

import jsonschema
import pytest

from fieldkit.config import schema
from fieldkit.config.documentation import attribute_meanings
from sim_backends.cosim.scenario.faults import JammerFault
from sim_backends.cosim.scenario.loading import editor_schema, scenario_files

SCHEMA = editor_schema()


def scenario_data(name: str) -> Any:  # noqa: ANN401 (any YAML value)
    return schema.read(scenario_files()[name]).data


def test_the_schema_of_editors_is_a_valid_json_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("name", scenario_files())
def test_every_shipped_scenario_is_valid(name: str) -> None:
    jsonschema.validate(scenario_data(name), SCHEMA)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("polcy",), {}),
        (("policy",), {"name": "best"}),
        (("duration",), 10),
        (("agents", "husky-1", "robot"), 3),
        (("agents", "husky-1", "motion"), {"kind": "hop"}),
        (("traffic", 0, "protocol"), "dds"),
        (("traffic", 0, "to"), []),
        (("faults",), [{"kind": "jammer"}]),
        (("physics",), {"federate": "gazebo", "options": {"speed": 1}}),
        (("network",), {"federate": "ns3", "options": {"standard": "802.11ax"}}),
    ],
    ids=str,
)
def test_wrong_scenarios_are_invalid(keys: tuple[str | int, ...], value: object) -> None:
    data = scenario_data("baylands")
    parent = data
    for key in keys[:-1]:
        parent = parent[key]
    parent[keys[-1]] = value
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data, SCHEMA)


def test_options_of_a_simulator_are_valid_if_the_scenario_uses_it() -> None:
    data = scenario_data("baylands")
    for federate, options in (("gazebo", {"settle_s": 1}), ("mujoco", None), ("./carts", {"speed": 1})):
        data["physics"] = {"federate": federate, "options": options}
        jsonschema.validate(data, SCHEMA)


def test_every_key_has_a_meaning() -> None:
    for part in (SCHEMA, *SCHEMA["$defs"].values()):
        for key, value in part.get("properties", {}).items():
            assert value["description"].endswith("."), key
    assert (
        attribute_meanings(JammerFault)["to"] == "Time when it ends; if omitted, it lasts until the end of the run."
    )
