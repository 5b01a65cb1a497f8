"""The physics federate `gazebo`, a program that couples a running Gazebo to the co-simulation."""

import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Final

from sim_backends.federates.compiling import CompiledProgram
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import ProgramFederate
from sim_backends.gazebo.gazebo_options import GazeboOptions

_SOURCE: Final = Path(__file__).parent / "adapter.cc"
_LIBRARIES: Final = (
    ("ignition-transport11", "ignition-msgs8"),  # Fortress
    ("gz-transport12", "gz-msgs9"),  # Garden
    ("gz-transport13", "gz-msgs10"),  # Harmonic
    ("gz-transport14", "gz-msgs11"),  # Ionic
    ("gz-transport15", "gz-msgs12"),  # Jetty
)
"""Gazebo Transport and its messages, by version of Gazebo."""
_INSTALL: Final = (
    "apt-get install g++ pkg-config nlohmann-json3-dev libignition-transport-dev (Debian 12, for Fortress); "
    "for newer versions libgz-transport13-dev (Harmonic) or another version, from Gazebo's package repository"
)


def adapter() -> CompiledProgram:
    """Return the adapter for the oldest installed version of Gazebo Transport; for Fortress if none is installed."""
    libraries = next((names for names in _LIBRARIES if _are_installed(names)), _LIBRARIES[0])
    # From Garden on, the namespaces and headers are called `gz` instead of `ignition`.
    flags = ["-O1", "-std=c++17"] if libraries is _LIBRARIES[0] else ["-O1", "-std=c++17", "-DFIELDKIT_GZ"]
    return CompiledProgram(
        "gazebo-adapter", _SOURCE, (*libraries, "nlohmann_json"), _INSTALL, flags=flags, duration_text="about 15 s"
    )


def _are_installed(names: tuple[str, ...]) -> bool:
    program = shutil.which("pkg-config")
    return program is not None and subprocess.run([program, "--exists", *names], check=False).returncode == 0


def _command() -> str:
    return shlex.quote(str(adapter().path()))


FEDERATE: Final = ProgramFederate(PHYSICS, _command, "a running Gazebo, in lock-step", GazeboOptions)
"""Target of the entry point `gazebo`."""
