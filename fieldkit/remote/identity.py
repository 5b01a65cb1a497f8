"""Addresses, host keys and credentials of robots."""

import base64
import binascii
import hashlib
from dataclasses import dataclass, field

from fieldkit.core.errors import ConfigurationError


@dataclass(frozen=True)
class Address:
    """Address of a robot, for messages. A function of type `sockets.Connect` opens the connection.

    Attributes:
        robot: Its name in the lab.
        host: Name or address for SSH.
        port: Its SSH port.
        user: Login name.
    """

    robot: str
    host: str
    port: int = 22
    user: str = ""

    @property
    def ssh_arguments(self) -> str:
        """The arguments for `ssh` or `ssh-copy-id` to this robot."""
        port = f"-p {self.port} " if self.port != 22 else ""
        return f"{port}{self.user}@{self.host}" if self.user else f"{port}{self.host}"


@dataclass(frozen=True)
class HostKey:
    """A public host key.

    Attributes:
        text: The key as in `known_hosts`: `ssh-ed25519 AAAA...`.
        server: Version string of the server, for example `SSH-2.0-dropbear_2022.83`; empty if unknown.
    """

    text: str
    server: str = field(default="", compare=False)

    @property
    def kind(self) -> str:
        """Type of the key, for example `ssh-ed25519`."""
        return self.text.partition(" ")[0]

    @property
    def fingerprint_command(self) -> str:
        """The command that shows the fingerprint on the robot; dropbear has a different key format."""
        name = "ecdsa" if self.kind.startswith("ecdsa-") else self.kind.removeprefix("ssh-")
        if "dropbear" in self.server:
            return f"dropbearkey -y -f /etc/dropbear/dropbear_{name}_host_key"
        return f"ssh-keygen -lf /etc/ssh/ssh_host_{name}_key.pub"

    @property
    def fingerprint(self) -> str:
        """`SHA256:...`, as `ssh-keygen -l` shows it."""
        digest = hashlib.sha256(base64.b64decode(self.text.partition(" ")[2])).digest()
        return f"SHA256:{base64.b64encode(digest).decode().rstrip('=')}"

    @classmethod
    def parse(cls, text: str, robot: str) -> "HostKey":
        """Return the pinned key of `robot`, without the comment after it.

        Raises:
            ConfigurationError: The text is not a host key.
        """
        try:
            kind, encoded = text.split()[:2]
            blob = base64.b64decode(encoded, validate=True)
        except (ValueError, binascii.Error):
            kind, blob = "", b""
        # RFC 4253, section 6.6: the blob begins with the length of the type, then the type itself.
        prefix = len(kind).to_bytes(4) + kind.encode()
        if not kind or not blob.startswith(prefix) or blob == prefix:
            raise ConfigurationError(
                "its pinned host key cannot be read", where=robot, remedy=f"fieldkit enroll {robot} --replace"
            )
        return cls(f"{kind} {encoded}")


@dataclass(frozen=True)
class Credentials:
    """The host key by which a robot is identified, and the key or password for the login.

    Attributes:
        host_key: Pinned host key.
        private_key: OpenSSH private key text; None uses the keys of the SSH agent, unless there is a password.
        password: The password, which is then the only login method; None to use keys.
    """

    host_key: HostKey
    private_key: str | None = field(default=None, repr=False)
    password: str | None = field(default=None, repr=False)
