"""SSH keys of an emulated lab: made per lab, never on the host's disk. The only user of `cryptography`."""

from dataclasses import dataclass
from typing import Self

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat


@dataclass(frozen=True)
class KeyPair:
    """An ed25519 key.

    Attributes:
        private: OpenSSH PEM text.
        public: `ssh-ed25519 AAAA...`.
    """

    private: str
    public: str

    @classmethod
    def make(cls) -> Self:
        """Return a new key."""
        key = Ed25519PrivateKey.generate()
        private = key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption())
        public = key.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH)
        return cls(private.decode(), public.decode())
