"""An unprivileged user whose account exists only in a separate mount namespace.

The module runs as `unshare --mount -- python -m tests.helpers.ordinary_user SCRIPT WORD...`. SCRIPT runs as root and
changes the mounts and files of the namespace; then the user runs the command WORD... in the home directory. The
changes disappear with the namespace.
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

# Ordinary systems make this device accessible to all users; minimal images do not.
_OPEN_TUN: Final = (
    "mount -t tmpfs tmpfs /mnt; mknod -m 666 /mnt/tun c 10 200; mount --bind /mnt/tun /dev/net/tun; umount -l /mnt"
)


def command(*words: str, change: str = "") -> tuple[str, ...]:
    """The command that runs `words` as the user, after the shell script `change` has run as root."""
    namespace = ("unshare", "--mount", "--propagation", "private", "--")
    return (*namespace, sys.executable, "-m", "tests.helpers.ordinary_user", change, *words)


def environment() -> dict[str, str]:
    """The environment variables for `command`."""
    return os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "HOME": str(HOME)}


def main() -> None:
    """Prepare the mount namespace, and run the command as the user."""
    mounts.isolate()
    Path("/root").chmod(0o755)  # the Python interpreter may be in there
    accounts = Path("/etc/passwd").read_text(encoding="utf-8")
    account_files = {
        "passwd": f"{accounts}{NAME}:x:{UID}:{UID}::{HOME}:/bin/sh\n",
        "subuid": f"{NAME}:200000:65536\n",
        "subgid": f"{NAME}:200000:65536\n",
    }
    for name, content in account_files.items():
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
