"""A server like Gazebo Fortress on loopback, compiled against the Gazebo libraries of Debian 12."""

import os
import signal
import subprocess
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sim_backends.federates.compiling import CompiledProgram

_INSTALL: Final = ".ci/install --dev"
SERVER: Final = CompiledProgram(
    "gazebo-test-server",
    Path(__file__).with_suffix(".cc"),
    (
        "sdformat12",
        "ignition-physics5",
        "ignition-physics5-sdf",
        "ignition-plugin1-loader",
        "ignition-transport11",
        "ignition-msgs8",
    ),
    _INSTALL,
    flags=("-O1", "-std=c++17"),
    duration_text="about 20 s",
)


def missing_libraries() -> str:
    """Return the reason why the server cannot be compiled on this machine; empty if it can."""
    packages = (*SERVER.packages, "nlohmann_json")
    try:
        missing = [
            name for name in packages if subprocess.run(["pkg-config", "--exists", name], check=False).returncode
        ]
    except FileNotFoundError:
        return "pkg-config is not installed"
    return f"Debian 12's libraries of Gazebo are not installed: {', '.join(missing)}" if missing else ""


@dataclass(frozen=True)
class GazeboServer:
    """A running server.

    Attributes:
        options: Options with which the federate `gazebo` connects to it.
        process: Its process.
    """

    options: dict[str, Any]
    process: "subprocess.Popen[str]"

    def suspend(self) -> None:
        """Suspend the server; the end of the context resumes it so that it can terminate."""
        os.kill(self.process.pid, signal.SIGSTOP)


@contextmanager
def gazebo_server(folder: Path, sdf: str, *arguments: str) -> Iterator[GazeboServer]:
    """Yield a server of an SDF world; only processes with the same partition on loopback can reach it.

    Args:
        folder: An empty folder.
        sdf: The world.
        arguments: Options of the server, see its source.
    """
    world = folder / "world.sdf"
    world.write_text(sdf, encoding="utf-8")
    partition = uuid.uuid4().hex
    environment = os.environ | {"IGN_PARTITION": partition, "IGN_IP": "127.0.0.1"}
    words = [str(SERVER.path()), str(world), *arguments]
    with subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            options = {"partition": partition, "ip": "127.0.0.1", "settle_s": 0.1, "timeout_s": 60}
            yield GazeboServer(options, process)
        finally:
            os.kill(process.pid, signal.SIGCONT)
            process.terminate()
