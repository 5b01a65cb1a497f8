"""An ordinary user and what it sees: a mount namespace with an account that this machine need not have.

Run as `unshare --mount -- python -m tests.ordinary_user SCRIPT WORD...`: as root, the script changes what the user
sees; then the user runs the words in its home. The machine keeps none of it, however that ends.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from sim_backends.emulated.robot import mounts
from tests.helpers.paths import ROOT

NAME: Final = "operator-of-tests"
UID: Final = 54321
HOME: Final = Path("/home", NAME)

# Ordinary systems open the device to everyone, bare images do not.
_OPEN_TUN: Final = (
    "mount -t tmpfs tmpfs /mnt; mknod -m 666 /mnt/tun c 10 200; mount --bind /mnt/tun /dev/net/tun; umount -l /mnt"
)


def command(*words: str, change: str = "") -> tuple[str, ...]:
    """Return the command that runs `words` as the user, after root ran the shell script `change`."""
    own = ("unshare", "--mount", "--propagation", "private", "--")
    return (*own, sys.executable, "-m", "tests.helpers.ordinary_user", change, *words)


def environment() -> dict[str, str]:
    """Return the environment that `command` wants."""
    return os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "HOME": str(HOME)}


def main() -> None:
    """Prepare what the user sees, and become the user."""
    mounts.isolate()
    Path("/root").chmod(0o755)  # this Python may live there
    accounts = Path("/etc/passwd").read_text(encoding="utf-8")
    own = {
        "passwd": f"{accounts}{NAME}:x:{UID}:{UID}::{HOME}:/bin/sh\n",
        "subuid": f"{NAME}:200000:65536\n",
        "subgid": f"{NAME}:200000:65536\n",
    }
    for name, content in own.items():
        file = Path("/run", name)
        file.write_text(content, encoding="utf-8")
        mounts.bind(file, Path("/etc", name))
    HOME.mkdir()
    os.chown(HOME, UID, UID)
    os.chdir(HOME)
    for script in (_OPEN_TUN, sys.argv[1]):
        subprocess.run(("sh", "-e", "-c", script), check=True)
    ids = (f"--reuid={UID}", f"--regid={UID}", "--clear-groups", "--inh-caps=-all")
    os.execvp("setpriv", ("setpriv", *ids, "--", *sys.argv[2:]))


if __name__ == "__main__":
    main()
