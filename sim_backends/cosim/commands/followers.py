"""How well followers kept their positions, as columns of a table."""

from typing import Final

from sim_backends.cosim.commands.sheets import SheetColumn, Value
from sim_backends.cosim.studies.formation import Formation

FORMATION: Final = (
    SheetColumn("spacing_mean_m", "spacing (cm)", "error of the distance behind a leader, magnitude, mean", 1e2),
    SheetColumn("spacing_max_m", "max", "its maximum", 1e2),
    SheetColumn(
        "station_mean_m", "station (cm)", "distance of a drone from its station above its leaders, mean", 1e2
    ),
    SheetColumn("station_max_m", "max", "its maximum", 1e2),
    SheetColumn("amplification", "amplified", "acceleration over the leader's; up to 1 the row is string stable"),
)
"""Columns of a `Formation`, in the order of `formation_values`."""


def formation_values(formation: Formation) -> tuple[Value, ...]:
    """Return the values of the columns `FORMATION`."""
    return (
        formation.spacing_mean_m,
        formation.spacing_max_m,
        formation.station_mean_m,
        formation.station_max_m,
        formation.amplification,
    )
