"""The procedures and profiles in the folder of a lab; most of them are changed copies of shipped files."""

from pathlib import Path

from fieldkit.config.locations import SITE_FILE, Kind
from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.paths import ROOT

BOX = """\
name: box
summary: A computer with a radio and no ROS
kind: ugv
computer: any
radio: {interface: wlan0, standard: 802.11n, tx_power_dbm: 17, sensitivity_dbm: -82}
limits: {max_speed_m_s: 1}
"""
"""The profile of a robot without ROS."""


def replace_text(text: str, *changes: str) -> str:
    """The text with replacements, given as pairs of old and new strings; each old string must occur."""
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        assert old in text, old
        text = text.replace(old, new)
    return text


def site_with_late_packets(*options: str) -> str:
    """A site file with the default robots, in which a repeat is not void if a busy machine delivers packets late.

    Tests that use it must not compare delays.

    Args:
        options: Further options of emulated robots, in YAML: `ros: builtin`.
    """
    options_text = ", ".join(("late_bound: 2s", *options))
    return f"{DEFAULT_SITE.read_text(encoding='utf-8')}\nemulated: {{{options_text}}}\n"


def built_in_ros(folder: Path, name: str = SITE_FILE, *, radio: str = "{}") -> Path:
    """Write a `site_with_late_packets` with the built-in ROS instead of Debian's; return its path.

    Tests that do not depend on ROS use it, because a short trial then takes two thirds of the CPU time. `radio` has
    the radio's options.
    """
    site = folder / name
    site.write_text(site_with_late_packets("ros: builtin", f"radio: {radio}"), encoding="utf-8")
    return site


def copy_shipped(lab: Path, kind: Kind, name: str, *changes: str, called: str = "") -> None:
    """Write a changed copy of a shipped file to a lab, under its name or the name `called`."""
    text = (ROOT / kind / f"{name}.yaml").read_text(encoding="utf-8")
    (lab / kind).mkdir(exist_ok=True)
    (lab / kind / f"{called or name}.yaml").write_text(replace_text(text, *changes), encoding="utf-8")


def write_procedure(lab: Path, text: str) -> str:
    """Write a procedure to a lab; return its name."""
    name = text.partition("\n")[0].removeprefix("name: ")
    (lab / "procedures").mkdir(exist_ok=True)
    (lab / "procedures" / f"{name}.yaml").write_text(text, encoding="utf-8")
    return name
