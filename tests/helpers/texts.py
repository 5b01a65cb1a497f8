"""Texts of site files and procedures for tests."""

from collections.abc import Mapping
from textwrap import indent
from types import MappingProxyType
from typing import Final

TURTLEBOTS: Final[Mapping[str, str]] = MappingProxyType(
    {"turtlebot-1": "turtlebot3_burger", "turtlebot-2": "turtlebot3_burger"}
)
TURTLEBOTS_AND_DRONE: Final[Mapping[str, str]] = MappingProxyType({**TURTLEBOTS, "duckiedrone-1": "duckiedrone"})


def site(robots: Mapping[str, str] = TURTLEBOTS, *, emulated: str = "", backend: str = "emulated") -> str:
    """A site file. With two robots, the topology is `masterless`; with three, it is `master`, and the third is the
    relay.

    Args:
        robots: Profile by name of the robot, in the order sender, receiver, relay.
        emulated: Options of emulated robots, in YAML without the outer braces: `ros: builtin, record_air: true`. With
            options, a repeat is not void if a busy machine delivers packets late, unless they have a `late_bound`.
        backend: Name of the backend.
    """
    entries = "".join(f"  {name}: {{profile: {profile}}}\n" for name, profile in robots.items())
    roles = ", ".join(f"{role}: {name}" for role, name in zip(("sender", "receiver", "relay"), robots, strict=False))
    topology = "master" if len(robots) > 2 else "masterless"
    text = f"backend: {backend}\nrobots:\n{entries}roles:\n  {topology}: {{{roles}}}\n"
    bound = "" if "late_bound:" in emulated else ", late_bound: 2s"
    return text + (f"emulated: {{{emulated}{bound}}}\n" if emulated else "")


def procedure(
    name: str,
    steps: str,
    *,
    topology: str = "masterless",
    protocols: str = "tcp",
    repeats: int | str = 1,
    attempts: int | None = 1,
    more: str = "",
) -> str:
    """A procedure in line of sight.

    Args:
        name: Its name.
        steps: The list of steps in YAML, without indentation.
        topology: Its topology.
        protocols: Its protocols, separated by commas.
        repeats: Number of repeats.
        attempts: Maximum number of attempts of a repeat; None for the default.
        more: Lines with other keys, in YAML.
    """
    attempts_line = "" if attempts is None else f"attempts: {attempts}\n"
    return (
        f"name: {name}\nsummary: A procedure of a test\nscenario: los\ntopology: {topology}\n"
        f"protocols: [{protocols}]\nrepeats: {repeats}\n{attempts_line}{more}steps:\n{indent(steps, '  ')}"
    )
