"""Sections: keys of profiles and procedures that installed packages add, each with a model of its value."""

from collections.abc import Mapping
from functools import cache, partial
from importlib.metadata import EntryPoint
from typing import ClassVar, TypeVar

from typing_extensions import override

from fieldkit.config.schema import BaseModel, ConfigDict, SectionValue, Strict
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.lazy_mapping import LazyMapping

Section = TypeVar("Section")


class Sectioned(Strict):
    """A mapping with fields, and with sections of installed packages.

    A section without a value is absent. A key whose package is not installed is an error.

    Attributes:
        section_group: Entry point group of its sections: `KEY = "package.module:Class"`.
        section_base: Class from which the models of sections derive.
    """

    model_config = ConfigDict(extra="allow")

    __pydantic_extra__: dict[str, SectionValue]

    section_group: ClassVar[str]
    section_base: ClassVar[type]

    @classmethod
    @override
    def section_types(cls) -> Mapping[str, type[BaseModel]]:
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


@cache
def _section_types(group: str, base: type) -> LazyMapping[type[BaseModel]]:
    points = {point.name: point for point in plugins.entry_points(group)}
    return LazyMapping(points, partial(load_model, base))


def load_model(base: type, point: EntryPoint) -> type[BaseModel]:
    """Return the model of a section.

    Raises:
        ConfigurationError: The entry point cannot be loaded, or its object does not derive from `base`.
    """
    model, location = plugins.load(point), plugins.location(point)
    if not (isinstance(model, type) and issubclass(model, base) and issubclass(model, BaseModel)):
        name = base.__name__
        raise ConfigurationError(f"a section must be a subclass of {name}", where=location, remedy=plugins.REMEDY)
    return model
