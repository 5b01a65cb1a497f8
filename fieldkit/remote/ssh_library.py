"""paramiko, the protocol and the formats of keys, in half its time to import: without what it seldom needs."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Final

_NAME: Final = "invoke"
"""paramiko runs the commands of `Match exec` by it, a line of ssh_config; it imports asyncio and unittest."""


class _Seldom(ModuleType):
    """Stands for a module that is imported when something of it is asked for."""

    def __getattr__(self, name: str) -> object:
        return getattr(import_module(self.__name__), name)


_stands = sys.modules.setdefault(_NAME, _Seldom(_NAME))
try:
    import paramiko
finally:
    if isinstance(_stands, _Seldom):
        del sys.modules[_NAME]

__all__ = ["paramiko"]
