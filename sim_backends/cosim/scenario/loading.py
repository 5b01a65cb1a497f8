"""Scenarios by name, or by the path of a file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, nearest
from sim_backends.cosim.scenario.schema import CosimScenario

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
    document = schema.read(_path(str(name_or_path)))
    for key, value in (changes or {}).items():
        *parents, last = key.split(".")
        inner = document.data
        for part in parents:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return schema.validate(document, CosimScenario)


def _path(name_or_path: str) -> Path:
    if name_or_path.endswith(".yaml"):
        return Path(name_or_path)
    known = scenario_files()
    if name_or_path not in known:
        hint = nearest(name_or_path, known, f"scenarios: {', '.join(known)}; or name a file that ends in .yaml")
        raise ConfigurationError(f"there is no scenario {name_or_path!r}", remedy=hint)
    return known[name_or_path]
