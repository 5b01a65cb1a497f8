"""Sections: keys of profiles and procedures that installed packages add, each with a model of its value."""

from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint
from typing import ClassVar, TypeVar

from typing_extensions import override

from fieldkit.config.schema import BaseModel, ConfigDict, Strict
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError

Section = TypeVar("Section")


class Sectioned(Strict):
    """A mapping with fields, and with sections of installed packages.

    A section without a value is absent. A key whose package is not installed is an error.

    Attributes:
        section_group: Entry point group of its sections: `KEY = "package.module:Class"`.
        section_base: Class from which the models of sections derive.
    """

    model_config = ConfigDict(extra="allow")

    section_group: ClassVar[str]
    section_base: ClassVar[type]

    @classmethod
    @override
    def section_types(cls) -> "SectionTypes":
        return _section_types(cls.section_group, cls.section_base)

    @classmethod
    @override
    def missing_package(cls, key: str) -> str:
        return plugins.owner(cls.section_group, key)

    def section(self, key: str, model: type[Section]) -> Section | None:
        """Return a section, or None if it is absent.

        Args:
            key: Its key.
            model: Its model.
        """
        section = (self.model_extra or {}).get(key)
        return section if isinstance(section, model) else None


class SectionTypes(Mapping[str, type[BaseModel]]):
    """The model of each section by key. A package is imported when its model is looked up.

    A look-up raises a `ConfigurationError` if the entry point cannot be loaded, or names another object.

    Args:
        points: The entry point of each section.
        base: Class from which the models derive.
    """

    def __init__(self, points: Mapping[str, EntryPoint], base: type) -> None:
        self._points = points
        self._base = base

    @override
    def __getitem__(self, key: str) -> type[BaseModel]:
        point = self._points[key]
        model = plugins.load(point)
        if not (isinstance(model, type) and issubclass(model, self._base) and issubclass(model, BaseModel)):
            raise ConfigurationError(
                f"a section must be a subclass of {self._base.__name__}",
                where=plugins.location(point),
                remedy=plugins.REMEDY,
            )
        return model

    @override
    def __contains__(self, key: object) -> bool:
        return key in self._points

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._points)

    @override
    def __len__(self) -> int:
        return len(self._points)


@cache
def _section_types(group: str, base: type) -> SectionTypes:
    return SectionTypes({point.name: point for point in plugins.entry_points(group)}, base)
