"""State of a robot's computer: processor load, temperature, supply voltage, throttling, batteries and disk space.

The source `health` prints lines of values from /proc, /sys and `df` (`fieldkit/remote/snapshot.sh`). `vcgencmd
get_throttled` prints the flags of a Raspberry Pi: bit 0 is under-voltage, bit 1 frequency capped, bit 2 throttled,
bit 3 soft temperature limit; bits 16 to 19 are the same flags since the last boot (raspberrypi.com, "vcgencmd"). The
kernel driver `rpi_volt` also reports under-voltage.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import Measured, Value
from fieldkit.core.model import Role
from fieldkit.measure.robot_state.marks import RepeatMark
from fieldkit.measure.robot_state.snapshots import Snapshot

NAME: Final = "health"
"""Name of the source with values of /proc, /sys and `df`."""
THROTTLED_NAME: Final = "vcgencmd"
"""Name of the source with the output of `vcgencmd get_throttled`."""

UNDER_VOLTAGE: Final = "under-voltage"
THROTTLED: Final = "throttled"
"""Names of marks."""
_FLAGS: Final = ("under-voltage", "frequency capped", "throttled", "soft temperature limit")
"""Flags in the order of their bits."""
_SINCE_BOOT: Final = 16
"""Position of the first of the flags since the last boot."""

_HEX: Final = re.compile(r"throttled=0x([0-9a-fA-F]{1,8})", re.ASCII)
_CPU: Final = re.compile(r"^cpu((?: +[0-9]{1,18}){4,12})$", re.MULTILINE | re.ASCII)
_TEMPERATURE: Final = re.compile(r"^temperature (-?[0-9]{1,6})$", re.MULTILINE | re.ASCII)
_BATTERY: Final = re.compile(r"^battery (?:([0-9]{1,3})|-) (?:([0-9]{1,9})|-)$", re.MULTILINE | re.ASCII)
_ALARM: Final = re.compile(r"^undervoltage ([01])$", re.MULTILINE | re.ASCII)
_DISK: Final = re.compile(r"^disk ([0-9]{1,13})$", re.MULTILINE | re.ASCII)
_SENSOR_C: Final = (-60.0, 200.0)
"""Range of plausible temperatures. Drivers print values outside of it for a sensor that is switched off."""


@dataclass(frozen=True)
class Health:
    """State of a robot's computer at one time. Unknown attributes are None.

    Attributes:
        busy_ticks: Processor time in use since boot, in clock ticks.
        all_ticks: Total processor time since boot, in clock ticks.
        temperature_c: Highest temperature of the sensors in degrees Celsius.
        flags: Flags that are set now, as named in `_FLAGS`.
        earlier_flags: Flags that were set at any time since boot.
        battery_share: Lowest charge of the batteries.
        battery_v: Lowest voltage of the batteries.
        disk_free_bytes: Free space in the user's home folder.
    """

    busy_ticks: int | None = None
    all_ticks: int | None = None
    temperature_c: float | None = None
    flags: frozenset[str] | None = None
    earlier_flags: frozenset[str] | None = None
    battery_share: float | None = None
    battery_v: float | None = None
    disk_free_bytes: int | None = None


def parse(snapshot: Snapshot) -> Health:
    """Return the state in a snapshot."""
    output = snapshot.get(NAME)
    text = "" if output is None or output.failure else output.text
    cpu = _CPU.search(text)
    ticks = [int(word) for word in cpu[1].split()] if cpu else []
    temperatures_c = [int(value) / 1000 for value in _TEMPERATURE.findall(text)]
    plausible_c = [value for value in temperatures_c if _SENSOR_C[0] <= value <= _SENSOR_C[1]]
    batteries = _BATTERY.findall(text)
    shares = [int(percent) / 100 for percent, _ in batteries if percent and int(percent) <= 100]
    volts = [int(microvolts) / 1e6 for _, microvolts in batteries if int(microvolts or 0)]
    disk = _DISK.search(text)
    now, earlier = _flags(snapshot)
    return Health(
        # The fourth and fifth values are idle and iowait; the first two values include the guest time (proc(5)).
        busy_ticks=sum(ticks[:8]) - sum(ticks[3:5]) if ticks else None,
        all_ticks=sum(ticks[:8]) if ticks else None,
        temperature_c=max(plausible_c, default=None),
        flags=now,
        earlier_flags=earlier,
        battery_share=min(shares, default=None),
        battery_v=min(volts, default=None),
        disk_free_bytes=int(disk[1]) << 10 if disk else None,
    )


def _flags(snapshot: Snapshot) -> tuple[frozenset[str] | None, frozenset[str] | None]:
    """Return the flags that are set now, and those that were set since boot; None for flags that are not reported."""
    output, health = snapshot.get(THROTTLED_NAME), snapshot.get(NAME)
    match = None if output is None or output.failure else _HEX.search(output.text)
    if match is not None:
        bits = int(match[1], 16)
        now, earlier = (
            frozenset(flag for position, flag in enumerate(_FLAGS) if bits >> (position + shift) & 1)
            for shift in (0, _SINCE_BOOT)
        )
        return now, earlier
    alarm = None if health is None or health.failure else _ALARM.search(health.text)
    if alarm is None:
        return None, None
    return frozenset({UNDER_VOLTAGE} if alarm[1] == "1" else ()), None


def flags_during(before: Health, after: Health) -> frozenset[str] | None:
    """Return the flags that were set before, during or after the attempt; None if they are unknown.

    A flag that was set only between the two states is detected if the robot reports the flags since boot, and if this
    flag had not been set since boot before the attempt.
    """
    if before.flags is None or after.flags is None:
        return None
    new = (after.earlier_flags or frozenset()) - (before.earlier_flags or frozenset())
    return before.flags | after.flags | new


def _busy_share(before: Health, after: Health) -> float | None:
    if before.busy_ticks is None or after.busy_ticks is None or before.all_ticks is None or after.all_ticks is None:
        return None
    busy_ticks, all_ticks = after.busy_ticks - before.busy_ticks, after.all_ticks - before.all_ticks
    return busy_ticks / all_ticks if 0 <= busy_ticks <= all_ticks and all_ticks > 0 else None


def measure(role: Role, before: Health, after: Health) -> Measured:
    """Return the columns of one robot's computer, from the states before and after an attempt."""
    flags = flags_during(before, after)
    temperatures_c = [state.temperature_c for state in (before, after) if state.temperature_c is not None]
    values: dict[str, Value | None] = {
        "cpu_share": _busy_share(before, after),
        "temperature_c": max(temperatures_c, default=None),
        "power_state": None if flags is None else ", ".join(flag for flag in _FLAGS if flag in flags) or "normal",
        "battery_share": after.battery_share,
        "battery_v": after.battery_v,
        "disk_free_bytes": after.disk_free_bytes,
    }
    prefixed = {f"{role}_{name}": value for name, value in values.items()}
    return Measured.from_optional(prefixed, "the robot does not report it")


def marks(names: Mapping[Role, str], flags_by_role: Mapping[Role, frozenset[str] | None]) -> Iterator[RepeatMark]:
    """Yield the marks of low supply voltages and throttled processors.

    Args:
        names: Name of the robot in each role.
        flags_by_role: Results of `flags_during`; None for a robot whose flags are unknown.
    """
    for role, flags in flags_by_role.items():
        if UNDER_VOLTAGE in (flags or ()):
            yield RepeatMark(UNDER_VOLTAGE, f"{names[role]}: the supply voltage is too low")
        if limits := [flag for flag in _FLAGS[1:] if flag in (flags or ())]:
            yield RepeatMark(THROTTLED, f"{names[role]}: the processor is throttled ({', '.join(limits)})")
