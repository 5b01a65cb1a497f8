"""Names of agents and flows in a scenario file."""

from typing import Annotated

from fieldkit.config.schema import BeforeValidator, Field

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,30}$")]
"""Of an agent, or of one entry of the traffic."""


def _several(value: object) -> object:
    return [value] if isinstance(value, str) else value


AgentNames = Annotated[
    tuple[Name, ...],
    Field(min_length=1, json_schema_extra={"type": ["string", "array"]}),
    BeforeValidator(_several),
]
"""One agent, or a list of several."""
