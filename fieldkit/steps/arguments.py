"""Variables in the arguments of a program: `{address.ROLE}`, `{distance}`, `{repeat}` and `{put}`.

Programs such as awk, jq and Go templates also use braces. Therefore only these names are replaced. `{{distance}}`
becomes the text `{distance}`. All other braces are unchanged, including shell variables such as `${distance}`. A name
that resembles one of these variables is refused, because it is most likely a typing error.
"""

import difflib
import re
from collections.abc import Callable, Mapping
from typing import Final

from fieldkit.core.errors import did_you_mean

PUT: Final = "put"
_VALUES: Final = ("distance", "repeat")
_ADDRESS: Final = "address"
_MIN_ABBREVIATION: Final = 4
"""Minimum length of a prefix of a name that counts as an abbreviation of it."""

_NAME: Final = r"address\.[^{}]*|\s*[A-Za-z_][A-Za-z0-9_.-]*\s*"
_BRACES: Final = re.compile(
    rf"(?P<shell>\$\{{+(?!address\.))|\{{\{{(?P<literal>{_NAME})\}}\}}|\{{(?P<name>{_NAME})\}}"
)
"""The start of a shell variable, a name in double braces, or a name in single braces."""


def fill_in(word: str, values: Mapping[str, str], address: Callable[[str], str]) -> str:
    """Return an argument in which the variables are replaced by their values.

    The result is one argument, even if a value contains whitespace.

    Args:
        word: The argument.
        values: Value by name of a variable; a variable without a value is not replaced.
        address: Returns the address of the robot in a role.
    """

    def replacement(match: re.Match[str]) -> str:
        if (literal := match["literal"]) is not None:
            return f"{{{literal}}}" if _is_variable(literal) or suggestion(literal) else match[0]
        name = match["name"]
        if name is None:
            return match[0]
        kind, dot, role = name.partition(".")
        if kind == _ADDRESS and dot:
            return address(role)
        return values.get(name, match[0])

    return _BRACES.sub(replacement, word)


def names(word: str) -> list[str]:
    """Return the texts in single braces in an argument that have the form of a variable, in their order."""
    return [name for match in _BRACES.finditer(word) if (name := match["name"]) is not None]


def roles(word: str) -> list[str]:
    """Return the roles of the variables `{address.ROLE}` in an argument."""
    return [name.partition(".")[2] for name in names(word) if name.startswith(f"{_ADDRESS}.")]


def problem(word: str, *, has_program: bool) -> str | None:
    """Return the reason why an argument has an invalid variable; None if all are valid.

    Args:
        word: The argument.
        has_program: Whether the step copies a program, so that `{put}` has a value.
    """
    for name in names(word):
        if name == PUT and not has_program:
            return f"{{put}} is the program copied by put:, and the step has no put:; {_escape(name)}"
        if hint := suggestion(name):
            return f"there is no variable {{{name}}}; {hint} {_escape(name)}"
    return None


def depends_on_repeat(word: str) -> bool:
    """Return True if an argument depends on the distance or the repeat."""
    return any(name in _VALUES for name in names(word))


def suggestion(name: str) -> str:
    """Return a question with the variable that a misspelled name resembles; empty if `name` is valid or unrelated."""
    if _is_variable(name):
        return ""
    kind, dot, role = name.strip().lower().partition(".")
    if dot:
        match = did_you_mean(kind, (_ADDRESS,), "")
        return f"did you mean '{{address.{role}}}'?" if match else ""
    for variable in (*_VALUES, PUT):
        if kind == variable or (variable != PUT and _resembles(kind, variable)):
            return f"did you mean '{{{variable}}}'?"
    return ""


def _is_variable(name: str) -> bool:
    return name in (*_VALUES, PUT) or name.startswith(f"{_ADDRESS}.")


def _resembles(name: str, variable: str) -> bool:
    if name.startswith(variable) or (len(name) >= _MIN_ABBREVIATION and variable.startswith(name)):
        return True
    return bool(difflib.get_close_matches(name, (variable,), n=1, cutoff=0.8))


def _escape(name: str) -> str:
    return f"write {{{{{name}}}}} for the text {{{name}}}"
