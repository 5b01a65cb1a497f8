"""Scenarios by name, or by the path of a file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from fieldkit.config import catalog, schema
from fieldkit.core.errors import ConfigurationError, nearest
from sim_backends.cosim.scenario.checks import check
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.world.world import load_world

_SHIPPED: Final = Path(__file__).parent / "scenarios"


def scenario_files() -> dict[str, Path]:
    """Return the file of each scenario by name: those that ship, and those of the lab's own folder `scenarios/`."""
    folders = (_SHIPPED, Path("scenarios"))
    found = {path.stem: path for folder in folders for path in folder.glob("*.yaml")}
    return dict(sorted(found.items()))


def load_scenario(name_or_path: str | Path, changes: Mapping[str, Any] | None = None) -> CosimScenario:
    """Return a scenario.

    Args:
        name_or_path: Its name, or the path of a file that ends in `.yaml`.
        changes: Values that take the place of the file's, by the keys that lead to them: `{"policy.window": "2ms",
            "agents.husky-2.along": "40m"}`.

    Raises:
        ConfigurationError: There is none, or it is wrong; says where.
    """
    path = _path(str(name_or_path))
    document = schema.read(path)
    try:
        for key, value in (changes or {}).items():
            _change(document.data, key.split("."), value)
        scenario = catalog.named(document, CosimScenario, path.stem)
        with document.naming("world"):
            world = load_world(scenario.world)
        check(scenario, world, document.where)
    except ConfigurationError as error:
        if changes:
            error.where = error.where or str(path)
            error.where += f" with {', '.join(f'{key}={value}' for key, value in changes.items())}"
        raise
    return scenario


def _change(data: Any, keys: list[str], value: Any) -> None:  # noqa: ANN401 (any YAML value)
    """Put a value at the end of keys; mappings that are not there yet are made.

    Raises:
        ConfigurationError: The keys lead through what has no keys, or beyond the end of a list.
    """
    *parents, last = (int(key) if key.isdecimal() else key for key in keys)
    try:
        for key in parents:
            data = data.setdefault(key, {}) if isinstance(data, dict) else data[key]
        data[last] = value
    except (IndexError, TypeError):
        raise ConfigurationError(
            f"there is no {'.'.join(keys)} to be changed",
            remedy="name keys as the scenario's file has them, and entries of a list by their number from 0 on",
        ) from None


def _path(name_or_path: str) -> Path:
    if name_or_path.endswith(".yaml"):
        return Path(name_or_path)
    known = scenario_files()
    if name_or_path not in known:
        hint = nearest(name_or_path, known, f"scenarios: {', '.join(known)}; or name a file that ends in .yaml")
        raise ConfigurationError(f"there is no scenario {name_or_path!r}", remedy=hint)
    return known[name_or_path]
