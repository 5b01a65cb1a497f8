"""Options of simulators: `physics.options` and `network.options` of a scenario."""

import json
from collections.abc import Iterator, Mapping
from typing import Any, Self

from fieldkit.config.schema import JsonValue, Location, Strict
from sim_backends.federates.handshake import Hello


class SimulatorOptions(Strict):
    """Base class of the options of simulators; a simulator without options uses it directly.

    Validation, defaults and documentation come from the model: its docstring contains the description of the
    simulator's options, and under `Attributes:` the meaning of each key.
    """

    @classmethod
    def of_run(cls, hello: Hello) -> Self:
        """Return the options of a run.

        Raises:
            ValueError: An option is invalid. This is possible only if the coordinator has not validated it.
        """
        return cls.model_validate(json.loads(hello.configuration).get("options", {}))

    def agent_names(self) -> Iterator[tuple[str, Location]]:
        """Yield the agent and the location of each option that refers to an agent of the scenario."""
        yield from ()

    def unsupported(self, scenario: Mapping[str, Any]) -> Iterator[tuple[str, Location]]:
        """Yield a message for each part of a scenario that the simulator does not support, and the part's location.

        Args:
            scenario: The scenario as in the configuration of hello, in JSON values.
        """
        del scenario
        yield from ()

    def further_configuration(self, configuration: Mapping[str, Any]) -> dict[str, Any]:
        """Return additional keys for the configuration in hello, for a simulator that cannot compute them.

        Args:
            configuration: The configuration with `scenario`, `world`, `robots` and `options`, in JSON values.
        """
        del configuration
        return {}

    def to_json(self) -> dict[str, Any]:
        """Return all options as JSON values, including defaults, without options that are None."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)


Options = SimulatorOptions | dict[str, JsonValue] | None
"""Options of a federate: a model, any mapping if the federate declares no options, or None for no options."""


def options_json(options: Options) -> dict[str, Any]:
    """Return options as JSON values."""
    return options.to_json() if isinstance(options, SimulatorOptions) else options or {}
