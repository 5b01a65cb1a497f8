"""Names of agents and flows in a scenario file."""

from typing import Annotated

from fieldkit.config.schema import BeforeValidator, Field, shaped

Name = Annotated[
    str, shaped(r"^[a-z][a-z0-9-]{0,30}$", "a name: small letters, digits and -, a small letter first, 31 in all")
]
"""Of an agent, or of one entry of the traffic."""


def _several(value: object) -> object:
    return [value] if isinstance(value, str) else value


AgentNames = Annotated[
    tuple[Name, ...],
    Field(min_length=1, json_schema_extra={"type": ["string", "array"]}),
    BeforeValidator(_several),
]
"""One agent, or a list of several."""
