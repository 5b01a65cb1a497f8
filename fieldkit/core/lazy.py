"""Data classes whose methods are compiled when the first object is made.

To declare one as `dataclasses` does takes 0.45 ms, nearly all of it for methods; a command imports above a hundred,
and makes objects of a few.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from threading import RLock
from typing import TYPE_CHECKING, Any, Final, NoReturn

__all__ = ["dataclass"]

_FIELDS: Final = "__dataclass_fields__"
_LENT: Final = ("__init__", "__repr__", "__eq__", "__hash__")
"""What an object is met by first, whether it was made here or comes out of a pickle."""
_OF_TYPE: Final = frozenset({"__dict__", "__weakref__"})
_LOCK: Final = RLock()

if TYPE_CHECKING:
    from dataclasses import dataclass
else:

    def dataclass(*, frozen: bool, **options: bool) -> Callable[[type], type]:
        """Declare a frozen data class; options as those of `dataclasses.dataclass`, but for `slots`."""
        if not frozen or "slots" in options:
            raise TypeError("only a frozen class without slots can be completed later: use dataclasses.dataclass")
        return lambda cls: _Later(cls, options).declared()


class _Later:
    """What a declared class lacks; stands for its fields, so that asking `dataclasses` for them completes it.

    Args:
        cls: The class, as its author wrote it.
        options: Of `dataclasses.dataclass`.
    """

    def __init__(self, cls: type, options: dict[str, bool]) -> None:
        self._cls = cls
        self._options = options
        self._written = {name: value for name, value in vars(cls).items() if name not in _OF_TYPE}
        self._lent = [name for name in _LENT if name not in self._written]

    def declared(self) -> type:
        """Return the class with methods that complete it."""
        for name in self._lent:
            setattr(self._cls, name, self._completing(name))
        for name, method in {"__setattr__": _refuse, "__delattr__": _refuse, _FIELDS: self}.items():
            setattr(self._cls, name, method)
        return self._cls

    def __get__(self, _instance: object, _owner: type) -> object:
        """Return the fields."""
        self._complete()
        return getattr(self._cls, _FIELDS)

    def _completing(self, name: str) -> Any:  # noqa: ANN401 (of four kinds)
        def method(*args: object, **named: object) -> object:
            self._complete()
            return getattr(self._cls, name)(*args, **named)

        return method

    def _complete(self) -> None:
        """Take over what `dataclasses` makes of a copy: no other thread meets the class without methods meanwhile."""
        with _LOCK:
            if vars(self._cls)[_FIELDS] is not self:
                return
            copy = type(self._cls)(self._cls.__name__, self._cls.__bases__, dict(self._written))
            made = dict(vars(dataclasses.dataclass(frozen=True, **self._options)(copy)))
            for name in self._written.keys() - made.keys() | set(self._lent) - made.keys():
                delattr(self._cls, name)
            for name in made.keys() - _OF_TYPE - {"__setattr__", "__delattr__", _FIELDS}:
                if name not in self._written or made[name] is not self._written[name]:
                    setattr(self._cls, name, made[name])
            setattr(self._cls, _FIELDS, made[_FIELDS])


def _refuse(_self: object, name: str, *_value: object) -> NoReturn:
    raise FrozenInstanceError(f"cannot assign to field {name!r}")
