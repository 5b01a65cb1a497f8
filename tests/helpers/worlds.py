"""Worlds with a few obstacles."""

from collections.abc import Mapping
from typing import Any, Final

from sim_backends.world.world import World

_DEFAULTS: Final[Mapping[str, Mapping[str, Any]]] = {
    "wall": {"height": "2m", "thickness": "0.1m", "material": "brick"},
    "tree": {"height": "6m", "crown_base": "2m", "crown_radius": "2m", "trunk_radius": "0.3m"},
    "box": {"material": "wood"},
    "building": {"thickness": "0.2m", "material": "brick"},
    "raised": {},
    "ramp": {},
}


def world(*obstacles: Mapping[str, Any]) -> World:
    """A world with obstacles in the format of a world file; missing values get defaults."""
    complete_obstacles = [{**_DEFAULTS[obstacle["kind"]], **obstacle} for obstacle in obstacles]
    return World.model_validate({"name": "w", "summary": "s", "area_m": (20, 20), "obstacles": complete_obstacles})
