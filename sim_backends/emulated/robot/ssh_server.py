"""The SSH server of an emulated robot: OpenSSH's or dropbear."""

import subprocess
from typing import Final

from sim_backends.emulated.robot.spec import SSH_PORT, STATE, RobotSpec

HOST_KEY: Final = f"{STATE}/ssh_host_ed25519_key"

_DROPBEAR_KEY: Final = f"{STATE}/dropbear_ed25519_host_key"
_TIMEOUT_S: Final = 5.0
"""Timeout of `dropbearconvert`."""


def convert_key(spec: RobotSpec) -> None:
    """Convert the host key in the file `HOST_KEY` to the format of the robot's SSH server.

    Raises:
        SubprocessError: The key could not be converted.
    """
    if spec.ssh == "dropbear":
        argv = ("dropbearconvert", "openssh", "dropbear", HOST_KEY, _DROPBEAR_KEY)
        subprocess.run(argv, capture_output=True, timeout=_TIMEOUT_S, check=True)


def command(spec: RobotSpec) -> tuple[str, ...]:
    """Return the command line of the robot's SSH server, which runs in the foreground and logs to standard error."""
    addresses = [f"{address}:{SSH_PORT}" for address in ("127.0.0.1", spec.ip)]
    return _dropbear(addresses) if spec.ssh == "dropbear" else _sshd(addresses, sftp=spec.sftp)


def _dropbear(addresses: list[str]) -> tuple[str, ...]:
    listen = (word for address in addresses for word in ("-p", address))
    # -s: no passwords.
    return ("/usr/sbin/dropbear", "-F", "-E", "-s", "-r", _DROPBEAR_KEY, *listen)


def _sshd(addresses: list[str], *, sftp: bool) -> tuple[str, ...]:
    options = [
        f"HostKey={HOST_KEY}",
        "PidFile=none",
        "UsePAM=no",
        "UseDNS=no",
        "PasswordAuthentication=no",
        "KbdInteractiveAuthentication=no",
        "PermitRootLogin=prohibit-password",
        "MaxSessions=64",
        "MaxStartups=64",
        "PrintLastLog=no",
        *["Subsystem=sftp internal-sftp"] * sftp,
        *(f"ListenAddress={address}" for address in addresses),
    ]
    words = (word for option in options for word in ("-o", option))
    return ("/usr/sbin/sshd", "-D", "-e", "-f", "/dev/null", *words)
