"""Addresses, host keys and credentials: the place of a robot, and the proofs of who is who."""

import base64
import binascii
import hashlib
from dataclasses import dataclass, field

from fieldkit.core.errors import ConfigurationError


@dataclass(frozen=True)
class Address:
    """Address of a robot, for messages; the way there is a `Connect`.

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
    def by_hand(self) -> str:
        """What a person types after `ssh` or `ssh-copy-id` to get there."""
        port = f"-p {self.port} " if self.port != 22 else ""
        return f"{port}{self.user}@{self.host}" if self.user else f"{port}{self.host}"


@dataclass(frozen=True)
class HostKey:
    """A public host key.

    Attributes:
        text: As in `known_hosts`: `ssh-ed25519 AAAA...`.
        server: What the server calls itself, `SSH-2.0-dropbear_2022.83`; empty where it was not asked.
    """

    text: str
    server: str = field(default="", compare=False)

    @property
    def kind(self) -> str:
        """Type of the key: `ssh-ed25519`."""
        return self.text.partition(" ")[0]

    @property
    def by_hand(self) -> str:
        """What a person types on the robot to see its fingerprint; dropbear keeps keys in its own way."""
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
        """Return the key that is pinned for `robot`, a comment after it left out.

        Raises:
            ConfigurationError: It is none.
        """
        try:
            kind, encoded = text.split()[:2]
            blob = base64.b64decode(encoded, validate=True)
        except (ValueError, binascii.Error):
            kind, blob = "", b""
        # RFC 4253, section 6.6: the blob begins with the length of the type, and the type.
        named = len(kind).to_bytes(4) + kind.encode()
        if not kind or not blob.startswith(named) or blob == named:
            raise ConfigurationError(
                "its pinned host key cannot be read", where=robot, remedy=f"fieldkit enroll {robot} --replace"
            )
        return cls(f"{kind} {encoded}")


@dataclass(frozen=True)
class Credentials:
    """Proofs that a robot owes us, and we owe it.

    Attributes:
        host_key: Pinned host key.
        private_key: OpenSSH private key text; None asks the SSH agent, unless there is a password.
        password: Tried alone where it is given.
    """

    host_key: HostKey
    private_key: str | None = field(default=None, repr=False)
    password: str | None = field(default=None, repr=False)
