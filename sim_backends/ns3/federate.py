"""The network federate `ns3`: its program and its command line."""

import re
import shlex
import subprocess
from pathlib import Path
from typing import Final

from sim_backends.federates.compiling import CompiledProgram
from sim_backends.federates.frames import NETWORK
from sim_backends.federates.named import ProgramFederate
from sim_backends.ns3.ns3_options import Ns3Options

_MODULES: Final = ("core", "network", "internet", "mobility", "propagation", "traffic-control", "wifi")
"""Modules of ns-3 that the program uses."""
_CPP20_SINCE: Final = (3, 43)
"""The headers of 3.37 do not compile as C++20. Later versions in Debian (3.43 and 3.48) do not compile as C++17."""


def version() -> str:
    """Return the version of the installed ns-3, for example `3.37`; empty if there is none."""
    try:
        command = ("pkg-config", "--modversion", "ns3-core")
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout.strip()
    except FileNotFoundError:
        return ""


def standard_flag(ns3_version: str) -> str:
    """Return the compiler option for the C++ standard that the headers of a version require."""
    numbers = tuple(int(number) for number in re.findall(r"\d+", ns3_version)[:2])
    return "-std=c++20" if numbers >= _CPP20_SINCE else "-std=c++17"


def program(ns3_version: str) -> CompiledProgram:
    """Return the program for a version of ns-3."""
    return CompiledProgram(
        name="ns3-network",
        source=Path(__file__).with_name("network.cc"),
        packages=("ns3-core", "ns3-wifi", "nlohmann_json"),
        install="apt-get install g++ pkg-config libns3-dev nlohmann-json3-dev",
        flags=("-O2", standard_flag(ns3_version)),
        # pkg-config also lists libgsl. Debian's libns3-dev does not install it, and ns-3 itself links it.
        libraries=tuple(f"-lns3-{module}" for module in _MODULES),
        duration_text="about 20 s",
    )


def command() -> str:
    """Return the command that serves the network; the program is compiled if necessary.

    Raises:
        ConfigurationError: ns-3 or the compiler is not installed, or the program cannot be compiled.
    """
    ns3_version = version()
    return shlex.join((str(program(ns3_version).path()), ns3_version))


NS3: Final = ProgramFederate(
    NETWORK,
    command,
    "ns-3's Wi-Fi, TCP and UDP, with the path loss of the world",
    Ns3Options,
    writes_captures=True,
    is_single_threaded=True,
)
