"""Variables in the arguments of a program: `{address.ROLE}`, `{distance}`, `{repeat}` and `{put}`.

Programs such as awk, jq and Go templates have braces of their own. So only these names are replaced, `{{distance}}`
stands for the text `{distance}`, and all other braces stay as they are. `${distance}` is of a shell, and stays.
A name that is almost one of these is refused, because it is most likely a typing error.
"""

import difflib
import re
from collections.abc import Callable, Mapping
from typing import Final

from fieldkit.core.errors import nearest

PUT: Final = "put"
_VALUES: Final = ("distance", "repeat")
_ADDRESS: Final = "address"
_SHORTEST: Final = 4
"""Letters of the beginning of a name that is taken for an abbreviation of it."""

_NAME: Final = r"address\.[^{}]*|\s*[A-Za-z_][A-Za-z0-9_.-]*\s*"
_BRACES: Final = re.compile(
    rf"(?P<shell>\$\{{+(?!address\.))|\{{\{{(?P<literal>{_NAME})\}}\}}|\{{(?P<name>{_NAME})\}}"
)


def filled(word: str, values: Mapping[str, str], address: Callable[[str], str]) -> str:
    """Return one argument with its variables filled in; it stays one argument, whatever the values are.

    Args:
        word: The argument.
        values: Value by name of a variable; a variable without a value stays as it is.
        address: Returns the address of the robot in a role.
    """

    def value(match: re.Match[str]) -> str:
        if (literal := match["literal"]) is not None:
            return f"{{{literal}}}" if _is_known(literal) or meant(literal) else match[0]
        name = match["name"]
        if name is None:
            return match[0]
        kind, dot, role = name.partition(".")
        if kind == _ADDRESS and dot:
            return address(role)
        return values.get(name, match[0])

    return _BRACES.sub(value, word)


def names(word: str) -> list[str]:
    """Return what stands in single braces in an argument, in order, where it could be the name of a variable."""
    return [name for match in _BRACES.finditer(word) if (name := match["name"]) is not None]


def roles(word: str) -> list[str]:
    """Return the roles whose addresses an argument has."""
    return [name.partition(".")[2] for name in names(word) if name.startswith(f"{_ADDRESS}.")]


def problem(word: str, *, has_program: bool) -> str | None:
    """Return why an argument cannot be filled in, None where it can.

    Args:
        word: The argument.
        has_program: Whether a program is copied for it, which `{put}` names.
    """
    for name in names(word):
        if name == PUT and not has_program:
            return f"{{put}} is the program that put: copies, and there is no put:; {_escape(name)}"
        if hint := meant(name):
            return f"there is no variable {{{name}}}; {hint} {_escape(name)}"
    return None


def varies(word: str) -> bool:
    """Return whether an argument depends on the distance or the repeat."""
    return any(name in _VALUES for name in names(word))


def meant(name: str) -> str:
    """Return which variable was probably meant by a name that is none; empty where it is one, or another's braces."""
    if _is_known(name):
        return ""
    kind, dot, role = name.strip().lower().partition(".")
    if dot:
        near = nearest(kind, (_ADDRESS,), "")
        return f"did you mean '{{address.{role}}}'?" if near else ""
    for known in (*_VALUES, PUT):
        if kind == known or (known != PUT and _is_like(kind, known)):
            return f"did you mean '{{{known}}}'?"
    return ""


def _is_known(name: str) -> bool:
    return name in (*_VALUES, PUT) or name.startswith(f"{_ADDRESS}.")


def _is_like(name: str, known: str) -> bool:
    abbreviated = len(name) >= _SHORTEST and known.startswith(name)
    return abbreviated or name.startswith(known) or bool(difflib.get_close_matches(name, (known,), n=1, cutoff=0.8))


def _escape(name: str) -> str:
    return f"write {{{{{name}}}}} for the text {{{name}}}"
