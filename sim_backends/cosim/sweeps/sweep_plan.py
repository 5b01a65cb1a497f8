"""The plan of a sweep: all its settings and runs.

The name of a run is a hash of the scenario with its settings, the files that it names, the seed, and the version of
fieldkit.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fieldkit.config import schema
from fieldkit.config.locations import names
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.sweeps.factors import Factor, load_combinations
from sim_backends.physics.robot_limits import BODIES
from sim_backends.world.world import world_files

_NOT_SETTINGS: Final = frozenset({"summary", "seeds"})
"""Keys of a scenario that do not change a run with a given seed."""


@dataclass(frozen=True)
class SweepSetting:
    """A scenario with a combination of values.

    Attributes:
        values: The values by the name of their factor, as given on the command line.
        scenario: The scenario with these values.
        digest: Result of the function `digest` for this scenario.
    """

    values: Mapping[str, str]
    scenario: CosimScenario
    digest: str

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.values.items())


@dataclass(frozen=True)
class SweepRun:
    """A run of a sweep.

    Attributes:
        setting: Its setting.
        seed: Seed of its random draws.
    """

    setting: SweepSetting
    seed: int

    @cached_property
    def name(self) -> str:
        """Name of the file of its result, without the suffix."""
        return hashlib.sha256(f"{self.setting.digest} seed {self.seed}".encode()).hexdigest()[:24]

    def __str__(self) -> str:
        return f"{self.setting}, seed {self.seed}"


@dataclass(frozen=True)
class SweepPlan:
    """All runs of a sweep.

    Attributes:
        scenario: The scenario without the values of the factors.
        factors: The factors.
        settings: All combinations of their values, in the order of the command line.
        seeds: Seeds of each combination.
    """

    scenario: CosimScenario
    factors: Sequence[Factor]
    settings: Sequence[SweepSetting]
    seeds: Sequence[int]

    @cached_property
    def runs(self) -> tuple[SweepRun, ...]:
        """All runs, by setting and seed."""
        return tuple(SweepRun(setting, seed) for setting in self.settings for seed in self.seeds)


def plan_sweep(
    name_or_path: str, factors: Sequence[Factor], seeds: Sequence[int], changes: Mapping[str, Any]
) -> SweepPlan:
    """Return the plan of a sweep.

    Args:
        name_or_path: Name or path of the scenario.
        factors: The factors.
        seeds: Seeds of each combination of values.
        changes: Values that replace values of the scenario file in all settings, by dotted key.

    Raises:
        ConfigurationError: A factor or a value is invalid, or two values are the same.
    """
    settings: dict[str, SweepSetting] = {}
    for values, scenario in load_combinations(name_or_path, factors, changes):
        values_by_name = dict(zip((factor.name for factor in factors), values, strict=True))
        setting = SweepSetting(values_by_name, scenario, digest(scenario))
        if (existing_setting := settings.setdefault(setting.digest, setting)) is not setting:
            raise ConfigurationError(
                f"--over: these are the same setting: {existing_setting}; and {setting}",
                remedy="remove one of the values",
            )
    all_settings = tuple(settings.values())
    return SweepPlan(load_scenario(name_or_path, changes), tuple(factors), all_settings, tuple(seeds))


def digest(scenario: CosimScenario) -> str:
    """Return a hash of a scenario, of its world and robot profiles, and of the version of fieldkit.

    It is the first 24 hex digits of a SHA-256. A worker whose files differ computes another hash.
    """
    settings = {
        key: value
        for key, value in schema.parse(schema.dump(scenario), source="").data.items()
        if key not in _NOT_SETTINGS
    }
    profiles = names("robots")
    robots = {plan.robot for plan in scenario.agents.values()} - BODIES.keys()
    paths: list[Path] = [world_files()[scenario.world], *(profiles[robot] for robot in sorted(robots))]
    files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
    content = {"fieldkit": version("fieldkit"), "scenario": settings, "files": files}
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:24]
