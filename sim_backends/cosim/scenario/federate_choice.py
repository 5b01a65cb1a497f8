"""The section of a scenario file that selects the federate (simulator) for physics or network, and its options."""

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Final

from fieldkit.config import schema
from fieldkit.config.schema import (
    AfterValidator,
    Field,
    Location,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
)
from sim_backends.federates.frames import NETWORK, PHYSICS, ROLES
from sim_backends.federates.named import federates, named_federate
from sim_backends.federates.simulator_options import Options, SimulatorOptions, options_json

BUILT_IN: Final = "builtin"
"""Name of the built-in physics and of the built-in network."""


def _without_built_in(name: str | None) -> str | None:
    return None if name == BUILT_IN else name


Federate = Annotated[str | None, AfterValidator(_without_built_in)]
"""Name, command or address of a federate; None for the built-in one."""


def _options_of(role: int) -> Callable[[Any, ValidationInfo], Options]:
    """Return a validator of `options`; the key `federate` of the same mapping determines which options are valid."""

    def validated(value: Any, info: ValidationInfo) -> Options:  # noqa: ANN401 (any YAML value)
        if not isinstance(value, dict | SimulatorOptions | None):
            raise schema.validation_error("this is not a mapping of keys to values")
        endpoint = info.data.get("federate")
        federate = None if endpoint is None else named_federate(endpoint, role)
        if federate is None or federate.options is None or isinstance(value, SimulatorOptions):
            return value
        return federate.options.model_validate(value or {})

    return validated


_JSON_SCHEMA: Final = WithJsonSchema({"anyOf": [{"type": "object"}, {"type": "null"}]})
_SERIALIZER: Final = PlainSerializer(lambda options: None if options is None else options_json(options))
# If a scenario has no options, the defaults of the simulator's options apply.
_VALIDATED_DEFAULT: Final = Field(validate_default=True)

PhysicsFederateOptions = Annotated[
    Options, PlainValidator(_options_of(PHYSICS)), _SERIALIZER, _JSON_SCHEMA, _VALIDATED_DEFAULT
]
"""Options of the physics federate that `federate` names in the same mapping."""
NetworkFederateOptions = Annotated[
    Options, PlainValidator(_options_of(NETWORK)), _SERIALIZER, _JSON_SCHEMA, _VALIDATED_DEFAULT
]
"""Options of the network federate that `federate` names in the same mapping."""


def agent_references(options: Options) -> Iterator[tuple[str, Location]]:
    """Yield every agent that options name, and the keys that lead to the name."""
    if isinstance(options, SimulatorOptions):
        yield from options.agent_names()


def unsupported(options: Options, scenario: schema.Strict) -> Iterator[tuple[str, Location]]:
    """Yield a message for each part of a scenario that the simulator does not support, and the keys of that part."""
    if isinstance(options, SimulatorOptions):
        yield from options.unsupported(scenario.model_dump(mode="json", by_alias=True, exclude_none=True))


def drop_options_of_replaced_federates(data: Any, changes: Mapping[str, Any]) -> None:  # noqa: ANN401 (any YAML value)
    """Remove the options of each federate that a change replaces, because they are valid only for the old federate.

    Args:
        data: Content of a scenario file, which is modified.
        changes: New values of keys of the file, by dotted key, for example `network.federate`.
    """
    for role in ROLES.values():
        section = data.get(role) if isinstance(data, dict) else None
        new_federate = changes.get(f"{role}.federate")
        if (
            isinstance(section, dict)
            and new_federate
            and section.get("federate") not in {None, BUILT_IN, new_federate}
        ):
            section.pop("options", None)


def add_options(definitions: dict[str, Any], sections: Mapping[str, str]) -> None:
    """Add the options of each installed simulator to the JSON schema; they apply if `federate` names the simulator.

    Args:
        definitions: The definitions of the JSON schema of scenarios.
        sections: Names of the definitions of the sections `physics` and `network`, by role.
    """
    for name, federate in federates().items():
        if federate.options is None:
            continue
        options_schema = federate.options.model_json_schema()
        definitions |= options_schema.pop("$defs", {})
        definitions[f"{name}.options"] = options_schema
        section = definitions[sections[ROLES[federate.role]]]
        reference = {"$ref": f"#/$defs/{name}.options"}
        section.setdefault("allOf", []).append(
            {
                "if": {"properties": {"federate": {"const": name}}, "required": ["federate"]},
                "then": {"properties": {"options": {"anyOf": [reference, {"type": "null"}]}}},
            }
        )
