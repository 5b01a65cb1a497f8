"""Workaround that lets rosbags open SQLite databases at any path.

rosbags inserts the path into a URI without percent-encoding, although `?`, `#` and `%` have a special meaning in a
URI (sqlite.org/uri.html) and bytes that are not UTF-8 are not allowed. `allow_any` replaces the storage plugins of
rosbags by subclasses that encode the path.
"""

import os
from pathlib import Path, PosixPath
from urllib.parse import quote

from rosbags import rosbag2
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader, Sqlite3Writer


class _UriPath(PosixPath):
    """A path whose `str()` is percent-encoded for a URI."""

    def __str__(self) -> str:
        return quote(os.fsencode(super().__str__()))


class _AnyPathReader(Sqlite3Reader):
    def __init__(self, path: Path) -> None:
        super().__init__(_UriPath(path))  # the path is only used for the URI


class _AnyPathWriter(Sqlite3Writer):
    def __init__(self, path: Path, compression: rosbag2.CompressionMode) -> None:
        super().__init__(_UriPath(path), compression)
        self.path = path / f"{path.name}.db3"


def allow_any() -> None:
    """Patch rosbags so that this process can open databases at any path."""
    rosbag2.Reader.STORAGE_PLUGINS = {**rosbag2.Reader.STORAGE_PLUGINS, ".db3": _AnyPathReader}
    DirectoryReader.STORAGE_PLUGINS = {**DirectoryReader.STORAGE_PLUGINS, "sqlite3": _AnyPathReader}
    rosbag2.Writer.STORAGE_PLUGINS = {**rosbag2.Writer.STORAGE_PLUGINS, rosbag2.StoragePlugin.SQLITE3: _AnyPathWriter}
