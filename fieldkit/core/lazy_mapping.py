"""Objects of entry points, which are loaded on first use."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint
from typing import TypeVar

from typing_extensions import override

Item = TypeVar("Item")


class LazyMapping(Mapping[str, Item]):
    """The objects of entry points by name. An object is loaded when it is read for the first time.

    Args:
        points: The entry points.
        load: Loads the object of an entry point, or raises `ConfigurationError`.
    """

    def __init__(self, points: Mapping[str, EntryPoint], load: Callable[[EntryPoint], Item]) -> None:
        self._points = points
        self._load = cache(load)

    @override
    def __getitem__(self, name: str) -> Item:
        return self._load(self._points[name])

    @override
    def __contains__(self, name: object) -> bool:
        return name in self._points

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._points)

    @override
    def __len__(self) -> int:
        return len(self._points)
