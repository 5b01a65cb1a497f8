"""The names of agents and flows in a scenario file."""

from typing import Annotated

from fieldkit.config.schema import BeforeValidator, Field, pattern_field

Name = Annotated[
    str,
    pattern_field(r"^[a-z][a-z0-9-]{0,30}$", "a name: small letters, digits and -, a small letter first, 31 at most"),
]
"""The name of an agent, or of an entry of the traffic."""


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


AgentNames = Annotated[
    tuple[Name, ...],
    Field(min_length=1, json_schema_extra={"type": ["string", "array"]}),
    BeforeValidator(_as_list),
]
"""One agent, or a list of several."""
