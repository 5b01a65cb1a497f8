"""Hashes that show whether two trials were measured in the same way: the first 16 hexadecimal digits of SHA-256."""

import hashlib
import json
import os
from functools import cache
from pathlib import Path
from typing import Final

_HASH_DIGITS: Final = 16


@cache
def code_hash() -> str:
    """Return the first 16 digits of the hash of the names and contents of fieldkit's source files (.py and .sh)."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parent.parent
    file_paths = (f"{folder}/{name}" for folder, _, names in os.walk(package) for name in names)
    sources = (path.removeprefix(f"{package}/") for path in file_paths if path.endswith((".py", ".sh")))
    for name in sorted(sources, key=lambda name: name.split("/")):
        digest.update(f"{name}\0".encode() + (package / name).read_bytes() + b"\0")
    return digest.hexdigest()[:_HASH_DIGITS]


def data_hash(data: object) -> str:
    """Return the first 16 digits of the hash of plain data (as JSON with sorted keys)."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:_HASH_DIGITS]
