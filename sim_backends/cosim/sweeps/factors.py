"""Factors of a sweep: settings of a scenario, each with several values, and the scenarios of their combinations."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Topology
from fieldkit.core.units import (
    BITS_PER_S_PER_UNIT,
    BYTES_PER_UNIT,
    FRACTION_PER_UNIT,
    HERTZ_PER_UNIT,
    METRES_PER_S_PER_UNIT,
    METRES_PER_UNIT,
    SECONDS_PER_UNIT,
    parse_distance,
    parse_quantity,
)
from sim_backends.cosim.scenario.loading import load_scenario, parse_value
from sim_backends.cosim.scenario.schema import CosimScenario

DISTANCE: Final = "distance"
"""The factor that sets the distance between agents whose position is given with `along`.

`along` is the position on the line that the world file defines for the scenario's `line`.
"""

_SHORT_NAMES: Final = {
    "policy": "policy.name",
    "window": "policy.window",
    "physics": "physics.federate",
    "network": "network.federate",
}
"""Short names of factors, and their keys in the scenario's file."""
_NOT_SETTINGS: Final = frozenset({"name", "summary", "seeds"})
"""Keys of a scenario that cannot be factors."""
_BETWEEN_VALUES: Final = re.compile(r",(?![^\[{]*[\]}])")
"""A comma outside brackets."""
_PLAIN_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


_QUANTITIES: Final = (
    ("_s", "s", SECONDS_PER_UNIT),
    ("_m", "m", METRES_PER_UNIT),
    ("_m_s", "m/s", METRES_PER_S_PER_UNIT),
    ("_hz", "Hz", HERTZ_PER_UNIT),
    ("_bit_s", "bit/s", BITS_PER_S_PER_UNIT),
    ("_bytes", "B", BYTES_PER_UNIT),
    ("_db", "dB", {"dB": 1.0}),
    ("_dbm", "dBm", {"dBm": 1.0}),
    ("_value", "1", FRACTION_PER_UNIT),
)
"""For each kind of quantity: suffix and unit of its column of numbers, and the factors of all its units."""


def _parse_in_unit(text: str, unit: str, factors: dict[str, float]) -> float:
    """Parse a quantity and convert it to `unit`. Only levels in dB or dBm may be negative.

    Raises:
        ConfigurationError: `text` is not a quantity of this kind.
    """
    magnitude = text.removeprefix("-") if unit in {"dB", "dBm"} else text
    value = parse_quantity(magnitude, factors, "value")
    return value if magnitude == text else -value


@dataclass(frozen=True)
class Factor:
    """A setting with its values.

    Attributes:
        name: Its name on the command line.
        values: Its values as given on the command line, at least one.
    """

    name: str
    values: tuple[str, ...]

    @property
    def key(self) -> str:
        """The key in the scenario's file; the key of `distance` depends on the scenario."""
        return _SHORT_NAMES.get(self.name, self.name)

    @property
    def column(self) -> str:
        """Name of the column with the values as given on the command line."""
        return re.sub(r"[^a-z0-9_]", "_", self.name.lower())

    @property
    def numbers(self) -> tuple[str, str, tuple[float, ...]] | None:
        """Name, unit and values of a column of numbers in SI units; None if a value is not a number.

        The factor `distance` has no such column, because a table contains the distance of each flow.
        """
        if self.name == DISTANCE:
            return None
        if all(_PLAIN_NUMBER.fullmatch(value) for value in self.values):
            return f"{self.column}_value", "1", tuple(map(float, self.values))
        for suffix, unit, factors in _QUANTITIES:
            with suppress(ConfigurationError):
                return (
                    self.column + suffix,
                    unit,
                    tuple(_parse_in_unit(value, unit, factors) for value in self.values),
                )
        return None


def parse_factors(words: Sequence[str]) -> tuple[Factor, ...]:
    """Return the factors of `--over NAME=VALUE,...`.

    Raises:
        ConfigurationError: A word does not have this form, or a factor or a value is given twice.
    """
    factors: dict[str, Factor] = {}
    for word in words:
        name, separator, text = word.partition("=")
        values = tuple(value.strip() for value in _BETWEEN_VALUES.split(text))
        if not separator or not name or not all(values):
            raise ConfigurationError(
                f"--over: {word!r} is not NAME=VALUE,VALUE", remedy="write for example --over window=1ms,10ms"
            )
        factor = Factor(name, values)
        if factor.column in factors:
            raise ConfigurationError(f"--over: {name} is given twice", remedy="list all its values after one NAME=")
        if (other := next((other for other in factors.values() if other.key == factor.key), None)) is not None:
            raise ConfigurationError(
                f"--over: {other.name} and {name} are the same setting", remedy="list all its values after one NAME="
            )
        if len(set(values)) < len(values):
            raise ConfigurationError(f"--over: {name} has the same value twice", remedy="remove one of them")
        factors[factor.column] = factor
    return tuple(factors.values())


def load_combinations(
    name_or_path: str, factors: Sequence[Factor], changes: Mapping[str, Any]
) -> Iterator[tuple[tuple[str, ...], CosimScenario]]:
    """Yield each combination of values, in the order of the command line, and the scenario with these values.

    Args:
        name_or_path: Name or path of the scenario.
        factors: The factors.
        changes: Values that replace values of the scenario file in all combinations, by dotted key.

    Raises:
        ConfigurationError: There is no such factor, or a combination is invalid.
    """
    scenario = load_scenario(name_or_path, changes)
    for factor in factors:
        _require_setting(factor, scenario)
        if factor.key in changes:
            raise ConfigurationError(
                f"--over: another option sets {factor.key} to {changes[factor.key]}",
                remedy=f"remove this option, or {factor.name} from --over",
            )
    for values in product(*(factor.values for factor in factors)):
        values_by_name = dict(zip((factor.name for factor in factors), values, strict=True))
        all_changes = dict(changes) | {
            _SHORT_NAMES.get(name, name): _parse_value(name, value)
            for name, value in values_by_name.items()
            if name != DISTANCE
        }
        if DISTANCE in values_by_name:
            scenario_with_values = load_scenario(name_or_path, all_changes)
            all_changes |= _placement_changes(scenario_with_values, parse_distance(values_by_name[DISTANCE]).metres)
        yield values, load_scenario(name_or_path, all_changes)


def _parse_value(name: str, text: str) -> Any:  # noqa: ANN401 (any YAML value)
    """Return a value of `--over`, parsed like a value in the scenario's file."""
    return parse_value(text, f"--over {name}")


def _require_setting(factor: Factor, scenario: CosimScenario) -> None:
    """Check that the parent keys of a setting exist; the schema checks its last key.

    Raises:
        ConfigurationError: A parent key does not exist, so the setting would add a mapping to the scenario.
    """
    document = schema.parse(schema.dump(scenario), source="").data
    names = [*_SHORT_NAMES, DISTANCE, *(key for key, _ in _leaves(document) if key not in _NOT_SETTINGS)]
    *parents, _ = factor.key.split(".")
    parent: Any = document
    try:
        for key in parents:
            parent = parent[int(key) if isinstance(parent, list) else key]
    except (KeyError, IndexError, ValueError, TypeError):
        parent = None
    is_optional = factor.name in type(scenario).model_fields.keys() - _NOT_SETTINGS
    if factor.name in names or is_optional or (parents and isinstance(parent, dict)):
        return
    raise ConfigurationError(
        f"--over: {scenario.name} has no setting {factor.name!r}",
        remedy=did_you_mean(
            factor.name,
            names,
            f"settings: {', '.join(name for name in names if '.' not in name)}; or a key of its file",
        ),
    )


def _leaves(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:  # noqa: ANN401 (any YAML value)
    """Yield the joined keys and the value of each entry that is neither a mapping nor a list of mappings."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in items:
        name = f"{prefix}{key}"
        if isinstance(item, dict) or (isinstance(item, list) and item and isinstance(item[0], dict)):
            yield from _leaves(item, f"{name}.")
        else:
            yield name, item


def _placement_changes(scenario: CosimScenario, distance_m: float) -> dict[str, str]:
    """Return the changes of `along` that result in a distance between two agents.

    The two agents are the ends of the first flow or, with a relay, the sender and the relay. The distance from the
    sender to every agent on the line is scaled by the same ratio.

    Raises:
        ConfigurationError: The positions of the two agents are not given with `along`, or are equal.
    """
    along_m = {name: plan.along for name, plan in scenario.agents.items() if plan.along is not None}
    if scenario.traffic:
        _, source, destination = next(iter(scenario.traffic[0].flow_ends))
        is_relayed = scenario.topology is Topology.MASTER and scenario.relay not in {None, source, destination}
        peer = scenario.relay if is_relayed and scenario.relay else destination
        if source in along_m and peer in along_m and along_m[source] != along_m[peer]:
            origin_m = along_m[source]
            scale = distance_m / abs(along_m[peer] - origin_m)
            return {
                f"agents.{name}.along": f"{origin_m + (at_m - origin_m) * scale:.9f}m"
                for name, at_m in along_m.items()
            }
    raise ConfigurationError(
        f"--over: distance needs a first flow in {scenario.name} whose ends start at different `along` positions",
        remedy="sweep positions instead: --over 'agents.NAME.at_m=[10,0],[20,0]'",
    )
