"""Failsafes of the emulated autopilots for battery and ground station, and the reactions of the vehicle.

Sources for ArduCopter: https://ardupilot.org/copter/docs/failsafe-battery.html and
https://ardupilot.org/copter/docs/gcs-failsafe.html. Source for PX4: https://docs.px4.io/main/en/config/safety.html.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

from sim_backends.emulated.autopilot.mavlink_frames import dialect
from sim_backends.emulated.autopilot.modes import LANDING, RETURNING, Mode
from sim_backends.emulated.autopilot.onboard_estimates import Battery
from sim_backends.emulated.autopilot.parameters import Parameters

_WARNING: Final = dialect.MAV_SEVERITY_WARNING
_CRITICAL: Final = dialect.MAV_SEVERITY_CRITICAL
_INFO: Final = dialect.MAV_SEVERITY_INFO


@dataclass(frozen=True)
class VehicleState:
    """State of the vehicle on which failsafes depend.

    Attributes:
        now_ns: The current time.
        is_armed: True if it is armed.
        has_landed: True if it is on the ground.
        mode: Its mode.
        battery: Its battery.
    """

    now_ns: int
    is_armed: bool
    has_landed: bool
    mode: Mode
    battery: Battery


@dataclass(frozen=True)
class Reaction:
    """Reaction of a failsafe.

    Attributes:
        text: Text of the STATUSTEXT message, or empty.
        severity: MAV_SEVERITY of the text.
        mode: Mode to change to; None to keep the mode.
        disarm: True to stop the motors.
    """

    text: str = ""
    severity: int = _WARNING
    mode: Mode | None = None
    disarm: bool = False


class Failsafes(Protocol):
    """The failsafes of a vehicle.

    Attributes:
        active: True if a failsafe is triggered; HEARTBEAT then has MAV_STATE_CRITICAL.
        arming_errors: Reasons why the failsafes prevent arming; empty if they permit it.
    """

    @property
    def active(self) -> bool:
        """True if a failsafe is triggered."""

    @property
    def arming_errors(self) -> list[str]:
        """Reasons why the failsafes prevent arming; empty if they permit it."""

    def on_heartbeat(self, system: int, kind: int, now_ns: int) -> None:
        """Process a heartbeat: system id and MAV_TYPE of its sender."""

    def on_mode_change(self, now_ns: int) -> None:
        """Record that a client has changed the mode, or that the vehicle was disarmed."""

    def on_lost_set_points(self) -> None:
        """Record that the vehicle has changed its mode because set-points are missing, which only PX4 does."""

    def advance(self, state: VehicleState) -> Iterator[Reaction]:
        """Yield the reactions that are due; call it periodically."""


class ArduCopterFailsafes:
    """Battery and ground-station (GCS) failsafes of ArduCopter.

    A triggered battery failsafe lasts until the next boot. A triggered ground-station failsafe lasts until a
    heartbeat of the system SYSID_MYGCS arrives, or until FS_GCS_ENABLE is set to 0.

    Args:
        parameters: The vehicle's parameters; these failsafes read BATT_*, FS_GCS_* and SYSID_MYGCS.
    """

    _STAGES: Final = (("LOW", "is low"), ("CRT", "is critical"))

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        # Number of the highest stage in `_STAGES` that was triggered, from 1; 0 if none was.
        self._stage = 0
        # Time since which the voltage has been below the limit of a stage, by its name.
        self._below_ns: dict[str, int] = {}
        self._gcs_heartbeat_ns: int | None = None
        self._gcs_lost = False

    @property
    def active(self) -> bool:
        """Implement `Failsafes.active`."""
        return self._stage > 0 or self._gcs_lost

    @property
    def arming_errors(self) -> list[str]:
        """Implement `Failsafes.arming_errors`."""
        return ["Battery failsafe"] * (self._stage > 0) + ["GCS failsafe on"] * self._gcs_lost

    def on_heartbeat(self, system: int, kind: int, now_ns: int) -> None:  # noqa: ARG002 (any type counts)
        """Implement `Failsafes.on_heartbeat`."""
        if system == self._parameters["SYSID_MYGCS"]:
            self._gcs_heartbeat_ns = now_ns

    def on_mode_change(self, now_ns: int) -> None:
        """Implement `Failsafes.on_mode_change`: nothing depends on the mode."""

    def on_lost_set_points(self) -> None:
        """Implement `Failsafes.on_lost_set_points`: ArduCopter has no such failsafe."""

    def advance(self, state: VehicleState) -> Iterator[Reaction]:
        """Implement `Failsafes.advance`."""
        yield from self._battery(state)
        yield from self._gcs(state)

    def _battery(self, state: VehicleState) -> Iterator[Reaction]:
        """Yield the reactions to each stage of a low battery that is reached for the first time since the boot."""
        parameters = self._parameters
        for stage, (name, level_text) in enumerate(self._STAGES, 1):
            limit_v, limit_mah = parameters[f"BATT_{name}_VOLT"], parameters[f"BATT_{name}_MAH"]
            remaining_mah = parameters["BATT_CAPACITY"] - state.battery.used_mah
            is_low = limit_mah > 0 and remaining_mah < limit_mah
            if limit_v > 0 and state.battery.voltage_v < limit_v:
                since_ns = self._below_ns.setdefault(name, state.now_ns)
                is_low = is_low or state.now_ns - since_ns > parameters["BATT_LOW_TIMER"] * 1e9
            else:
                self._below_ns.pop(name, None)
            if not is_low or stage <= self._stage:
                continue
            self._stage = stage
            battery = state.battery
            yield Reaction(f"Battery 1 {level_text} {battery.voltage_v:.2f}V used {battery.used_mah:.0f} mAh")
            yield from self._action_reactions(
                int(parameters[f"BATT_FS_{name}_ACT"]), _BATTERY_ACTIONS, "Battery Failsafe", state
            )

    def _gcs(self, state: VehicleState) -> Iterator[Reaction]:
        """Yield the reactions to the loss of the ground station, and to its return."""
        parameters = self._parameters
        if not parameters["FS_GCS_ENABLE"] or self._gcs_heartbeat_ns is None:
            if self._gcs_lost:
                self._gcs_lost = False
                yield Reaction("GCS Failsafe Cleared")
            return
        is_lost = state.now_ns - self._gcs_heartbeat_ns > parameters["FS_GCS_TIMEOUT"] * 1e9
        if is_lost and not self._gcs_lost:
            self._gcs_lost = True
            yield from self._action_reactions(int(parameters["FS_GCS_ENABLE"]), _GCS_ACTIONS, "GCS Failsafe", state)
        elif self._gcs_lost and not is_lost:
            self._gcs_lost = False
            yield Reaction("GCS Failsafe Cleared")

    def _action_reactions(
        self, action: int, modes: dict[int, Mode], text: str, state: VehicleState
    ) -> Iterator[Reaction]:
        """Yield the reaction of a failsafe whose parameter has the value `action`.

        `modes` has the mode to change to for each value that changes the mode. A disarmed vehicle only reports the
        failsafe. On the ground, an armed vehicle is disarmed instead. While it lands, it continues to land.
        """
        mode = modes.get(action)
        if not state.is_armed or mode is None:
            yield Reaction(text)
        elif state.has_landed:
            yield Reaction(text, disarm=True)
        elif state.mode in LANDING:
            yield Reaction(f"{text} - Continuing Landing")
        else:
            yield Reaction(text, mode=mode)


_BATTERY_ACTIONS: Final = {1: Mode.LAND, 2: Mode.RTL, 3: Mode.RTL, 4: Mode.LAND, 6: Mode.RTL, 7: Mode.LAND}
"""Mode by BATT_FS_LOW_ACT or BATT_FS_CRT_ACT.

Modes that are not emulated are replaced by the mode that ArduCopter uses if they are not possible: SmartRTL by RTL
(3) or LAND (4), the landing sequence of a mission by RTL (6), BRAKE by LAND (7). 5 (terminate) only reports the
failsafe.
"""
_GCS_ACTIONS: Final = {1: Mode.RTL, 2: Mode.RTL, 3: Mode.RTL, 4: Mode.LAND, 5: Mode.LAND, 6: Mode.RTL, 7: Mode.LAND}
"""Mode by FS_GCS_ENABLE, with the same replacements; 2 was removed in ArduCopter 4.0, and is RTL here."""


class Px4Failsafes:
    """Ground-station (data-link) and battery failsafes of PX4.

    The vehicle first holds its position for COM_FAIL_ACT_T, so that a pilot can take over, unless this time is below
    1 s. A failsafe ends when a client changes the mode, or when the vehicle is disarmed.

    Args:
        parameters: The vehicle's parameters; these failsafes read NAV_DLL_ACT, COM_DL_LOSS_T, COM_LOW_BAT_ACT,
            BAT_*_THR and COM_FAIL_ACT_T.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._gcs_heartbeat_ns: int | None = None
        self._gcs_lost = False
        # Highest battery warning so far: 0 none, 1 low, 2 critical, 3 emergency.
        self._warning = 0
        self._active = False
        # Time and mode of the change that follows after the vehicle has held its position.
        self._pending_change: tuple[int, Mode] | None = None

    @property
    def active(self) -> bool:
        """Implement `Failsafes.active`."""
        return self._active

    @property
    def arming_errors(self) -> list[str]:
        """Implement `Failsafes.arming_errors`."""
        is_missing = self._parameters["NAV_DLL_ACT"] > 0 and (self._gcs_lost or self._gcs_heartbeat_ns is None)
        return ["No connection to the ground control station"] * is_missing

    def on_heartbeat(self, system: int, kind: int, now_ns: int) -> None:  # noqa: ARG002 (any system counts)
        """Implement `Failsafes.on_heartbeat`."""
        if kind == dialect.MAV_TYPE_GCS:
            self._gcs_heartbeat_ns = now_ns

    def on_mode_change(self, now_ns: int) -> None:  # noqa: ARG002
        """Implement `Failsafes.on_mode_change`: the failsafe ends."""
        self._active, self._pending_change = False, None

    def on_lost_set_points(self) -> None:
        """Implement `Failsafes.on_lost_set_points`: the failsafe lasts until the next call of `on_mode_change`."""
        self._active = True

    def advance(self, state: VehicleState) -> Iterator[Reaction]:
        """Implement `Failsafes.advance`."""
        yield from self._data_link(state)
        yield from self._battery(state)
        if self._pending_change is not None and state.now_ns >= self._pending_change[0]:
            mode, self._pending_change = self._pending_change[1], None
            yield Reaction("Failsafe activated", _CRITICAL, mode)

    def _data_link(self, state: VehicleState) -> Iterator[Reaction]:
        """Yield the reactions to the loss of the ground station, and to its return."""
        if self._gcs_heartbeat_ns is None:
            return
        is_lost = state.now_ns - self._gcs_heartbeat_ns > self._parameters["COM_DL_LOSS_T"] * 1e9
        if is_lost and not self._gcs_lost:
            self._gcs_lost = True
            yield Reaction("Connection to ground station lost", _INFO)
            yield from self._trigger(_DATA_LINK_ACTIONS.get(int(self._parameters["NAV_DLL_ACT"])), state)
        elif self._gcs_lost and not is_lost:
            self._gcs_lost = False
            yield Reaction("Connection to ground station regained", _INFO)

    def _battery(self, state: VehicleState) -> Iterator[Reaction]:
        """Yield the reactions to a battery warning that is higher than all since the boot."""
        parameters, charge = self._parameters, state.battery.charge
        warning = sum(charge < parameters[name] for name in ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR"))
        if warning <= self._warning:
            return
        self._warning = warning
        text = ("Low battery", "Critical battery", "Emergency battery level")[warning - 1]
        yield Reaction(text, _WARNING if warning == 1 else _CRITICAL)
        yield from self._trigger(_LOW_BATTERY_ACTIONS.get((int(parameters["COM_LOW_BAT_ACT"]), warning)), state)

    def _trigger(self, mode: Mode | None, state: VehicleState) -> Iterator[Reaction]:
        """Yield the change to a mode, or to Hold before it (see the class).

        Nothing is yielded if `mode` is None, if the vehicle is not in flight, or if it already lands or, unless
        `mode` is LAND, returns.
        """
        if (
            mode is None
            or not state.is_armed
            or state.has_landed
            or state.mode in (LANDING if mode is Mode.LAND else RETURNING)
        ):
            return
        self._active = True
        hold_s = self._parameters["COM_FAIL_ACT_T"]
        if mode is Mode.LOITER or hold_s < 1:
            yield Reaction("Failsafe activated", _CRITICAL, mode)
            return
        self._pending_change = state.now_ns + round(hold_s * 1e9), mode
        yield Reaction(f"Failsafe activated: entering Hold for {hold_s:.0f} seconds", _CRITICAL, Mode.LOITER)


_DATA_LINK_ACTIONS: Final = {1: Mode.LOITER, 2: Mode.RTL, 3: Mode.LAND}
"""Mode by NAV_DLL_ACT; 5 and 6 (terminate, lockdown) are not emulated."""
_LOW_BATTERY_ACTIONS: Final = {
    (1, 2): Mode.RTL,
    (1, 3): Mode.RTL,
    (2, 2): Mode.LAND,
    (2, 3): Mode.LAND,
    (3, 2): Mode.RTL,
    (3, 3): Mode.LAND,
}
"""Mode by COM_LOW_BAT_ACT and the warning: 2 is critical, 3 emergency."""
