"""Recordings of Linux's Wi-Fi that a benchmark compares with fieldkit; they are made in a virtual machine."""

import gzip
import shlex
import sys
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from sim_backends.emulated.linux_wifi import guest
from sim_backends.emulated.linux_wifi.virtual_machine import require_machine, run_in_machine

_ROOT: Final = Path(__file__).resolve().parent.parent
RECORDINGS: Final = _ROOT / "tests/data/hwsim/6.1.176"


def load(path: Path) -> str:
    """Return the text of a recording."""
    return gzip.decompress(path.read_bytes()).decode()


def save(path: Path, text: str) -> None:
    """Write a recording; equal texts are written as equal bytes."""
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def record(folder: Path, module: str, argument: str, *, radios: int, limit_s: float) -> str:
    """Run a module of the benchmarks in a new virtual machine, and exit if it fails.

    Args:
        folder: A folder that the virtual machine can read and write.
        module: The module, which prints the recording.
        argument: Its argument.
        radios: Number of radios of mac80211_hwsim.
        limit_s: Time limit.

    Returns:
        The output of the module.
    """
    output = folder / "recording"
    python = shlex.join((sys.executable, "-m", f"benchmarks.{module}", argument))
    script = f"{guest.prologue(_ROOT)}{python} >{shlex.quote(str(output))}\n"
    result = run_in_machine(require_machine(), script, Deadline.after(limit_s), radios=radios, results=folder)
    if result.code:
        sys.exit(result.output)
    return output.read_text(encoding="ascii")
