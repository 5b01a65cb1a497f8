"""What families of autopilots do each in its own way: modes, parameters, manners; a module each has its facts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

from sim_backends.emulated.autopilot.battery import Battery
from sim_backends.emulated.autopilot.parameters import FlightLimits, Parameter, Parameters


class Mode(Enum):
    """What it does in a mode, of those in which it flies without a pilot's sticks.

    Each family has its own names for them: OFFBOARD is PX4's, and GUIDED ArduCopter's, for where set-points lead.
    """

    TAKEOFF = auto()
    LOITER = auto()
    MISSION = auto()
    RTL = auto()
    HOMECOMING = auto()
    """The last piece of RTL: down to where home is."""
    LAND = auto()
    OFFBOARD = auto()


LANDING = frozenset({Mode.LAND, Mode.HOMECOMING})


@dataclass(frozen=True)
class Firmware:
    """A family of autopilots.

    Attributes:
        autopilot: MAV_AUTOPILOT.
        version: As AUTOPILOT_VERSION has it: major, minor, patch, type.
        capabilities: MAV_PROTOCOL_CAPABILITY.
        base: MAV_MODE_FLAG of its heartbeat, whatever it does.
        modes: The custom mode of each mode.
        refused: MAV_RESULT of what it does not do now.
        silent: Whether it says no more than that of a take-off, a landing, a mode that it refuses.
        prearm: What its texts begin with that say why it may not be armed, when asked, and when it is to be armed.
        unfit: Says why it may not be armed.
        parameters: Its parameters, for what a profile lets it do.
        guided_holds: Whether it stays in the mode of set-points, and where it is, when none comes.
        lifts_off: Whether set-points lift it off the ground.
        lands_anywhere: Whether it takes modes that land where it stands.
        first_item: Number of the first item of a mission: before it is home.
    """

    autopilot: int
    version: int
    capabilities: int
    base: int
    modes: Mapping[Mode, int]
    refused: int
    silent: bool
    prearm: tuple[str, str]
    unfit: Callable[[Parameters, Battery], list[str]]
    parameters: Callable[[FlightLimits], tuple[Parameter, ...]]
    guided_holds: bool
    lifts_off: bool
    lands_anywhere: bool
    first_item: int

    def mode_of(self, custom_mode: int) -> Mode | None:
        """Return the mode of a number; None for one that it does not have."""
        return next((mode for mode, number in self.modes.items() if number == custom_mode), None)
