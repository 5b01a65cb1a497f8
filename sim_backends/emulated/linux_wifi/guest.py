"""Runs commands of fieldkit in the virtual machine, with their results in a folder of the host."""

import os
import shlex
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from sim_backends.emulated.linux_wifi.virtual_machine import (
    INTERRUPT,
    MESH_PACKAGE_OF,
    PACKAGE_OF,
    find_program,
    kernel_roots,
    require_machine,
    run_in_machine,
)
from sim_backends.emulated.process import worker
from sim_backends.emulated.robot.mesh_options import MeshOptions

_MAX_DURATION_S: Final = 7 * 24 * 3600.0
"""Time limit of a command: a week."""
_PROLOGUE: Final = """\
mkdir -p /usr/local/sbin
{links}
cd {folder} || exit
export {variables}
"""
_COMMAND: Final = f"""\
( while sleep 1; do if [ -e {INTERRUPT} ]; then rm {INTERRUPT}; kill -INT $$; fi; done ) &
exec """
"""Beginning of the line that runs the command: when the file `INTERRUPT` appears, a loop sends the command SIGINT."""


def run_command(argv: Sequence[str], results: Path, *, radios: int, mesh: MeshOptions | None = None) -> int:
    """Run a command of fieldkit in a new virtual machine; this process writes the output of the command.

    Args:
        argv: The words after `fieldkit`.
        results: Folder of the host that the command may change, created if it is missing. Other changes are lost.
        radios: Number of radios.
        mesh: The robots' mesh, which may need further programs and kernel modules.

    Returns:
        Exit code of the command.

    Raises:
        ConfigurationError: A program, or the kernel of the machine, is not installed.
        TestbedLostError: The machine ended before the command.
    """
    kernel = require_machine(mesh=mesh)
    results.mkdir(parents=True, exist_ok=True)
    # Ctrl-C interrupts the command in the machine, which finishes its repeat. A second Ctrl-C ends the machine.
    previous_handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = run_in_machine(
            kernel,
            prologue(Path.cwd()) + _COMMAND + shlex.join((*worker.command("fieldkit"), *argv)),
            Deadline.after(_MAX_DURATION_S),
            radios=radios,
            results=results.resolve(),
            on_output=_write,
        )
    finally:
        signal.signal(signal.SIGINT, previous_handler)
    return result.code


def prologue(folder: Path) -> str:
    """Return the part of a shell script that prepares the machine for programs of fieldkit in a folder."""
    # If packages were extracted to a folder, their programs are not in a folder of the robots' PATH. Links to them
    # are created in /usr/local/sbin, which is in this PATH.
    links = [
        shlex.join(("ln", "-sf", path, f"/usr/local/sbin/{name}"))
        for name in PACKAGE_OF | MESH_PACKAGE_OF
        if shutil.which(name, path=worker.PATH) is None and (path := find_program(name, kernel_roots())) is not None
    ]
    variables = {
        "PATH": worker.PATH,
        "HOME": os.environ.get("HOME", "/"),
        "LANG": "C.UTF-8",
        "PYTHONPATH": str(worker.PROJECT),
    }
    return _PROLOGUE.format(
        links="\n".join(links),
        folder=shlex.quote(str(folder)),
        variables=" ".join(f"{name}={shlex.quote(value)}" for name, value in variables.items()),
    )


def _write(data: bytes) -> None:
    sys.stdout.write(data.decode(errors="replace"))
    sys.stdout.flush()
