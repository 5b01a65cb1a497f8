"""Conditions on rows of a table, written as expressions of Python: `distance_m < 20 and topology == "master"`.

Columns of the type bool, comparisons of columns and constants, and their combinations with `and`, `or` and `not` are
allowed; no code is executed. A comparison with a missing value is neither true nor false (three-valued logic, Kleene
1938). A row is therefore selected only if its values are sufficient to decide the condition.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, did_you_mean

_EXAMPLE: Final = "write for example --where 'distance_m < 20 and topology == \"master\"'"
_ORDER: Final[dict[type[ast.cmpop], Callable[[Any, Any], Any]]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_EQUALITY: Final[dict[type[ast.cmpop], Callable[[Any, Any], Any]]] = {ast.Eq: operator.eq, ast.NotEq: operator.ne}
_MEMBERSHIP: Final = (ast.In, ast.NotIn)

Mask = NDArray[np.bool_]


class Truth(NamedTuple):
    """The result of a condition for each row. If missing values leave it undecided, neither mask is set.

    Attributes:
        true: Mask of the rows in which the condition is true. Shape (n,).
        false: Mask of the rows in which the condition is false. Shape (n,).
    """

    true: Mask
    false: Mask


@dataclass(frozen=True)
class RowFilter:
    """A condition on rows.

    Attributes:
        text: The expression.
        names: Names of the columns in the expression.
    """

    text: str
    names: frozenset[str]

    def mask(self, rows: Repeats) -> Mask:
        """Return a mask of the rows in which the condition is true. Shape (n,)."""
        return _truth(ast.parse(self.text.strip(), mode="eval").body, rows).true


def parse_filter(text: str, columns: Mapping[str, Column]) -> RowFilter:
    """Return the condition of an expression.

    Args:
        text: The expression.
        columns: The columns of the table by name; `source` is also allowed.

    Raises:
        ConfigurationError: The text is not an allowed expression, a column in it does not exist, or it compares a
            text with a number.
    """
    try:
        body = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        raise ConfigurationError(f"--where: {text!r} is not an expression: {reason}", remedy=_EXAMPLE) from None
    types = {SOURCE: str, **{name: column.type for name, column in columns.items()}}
    try:
        _check(body, types)
    except RecursionError:
        raise ConfigurationError("--where: the expression is nested too deeply", remedy=_EXAMPLE) from None
    names = {node.id for node in ast.walk(body) if isinstance(node, ast.Name)} & types.keys()
    return RowFilter(text, frozenset(names))


def _check(node: ast.expr, types: Mapping[str, type]) -> None:
    """Raise ConfigurationError for a condition that is not allowed."""
    match node:
        case ast.BoolOp(values=conditions):
            for condition in conditions:
                _check(condition, types)
        case ast.UnaryOp(op=ast.Not(), operand=condition):
            _check(condition, types)
        case ast.Name() if _type(node, types) is bool:
            pass
        case ast.Compare(left=left, ops=operators, comparators=others):
            terms = [left, *others]
            for first, comparison, second in zip(terms, operators, others, strict=False):
                _check_comparison(first, comparison, second, types)
        case _:
            raise _not_allowed(node)


def _check_comparison(first: ast.expr, comparison: ast.cmpop, second: ast.expr, types: Mapping[str, type]) -> None:
    """Raise ConfigurationError for a comparison that is not allowed."""
    kind = _type(first, types)
    if isinstance(comparison, _MEMBERSHIP) and isinstance(second, ast.List | ast.Tuple | ast.Set):
        others = {_type(element, types) for element in second.elts}
    elif type(comparison) in _ORDER | _EQUALITY:
        others = {_type(second, types)}
    else:
        raise _not_allowed(second)
    text = ast.unparse(ast.Compare(first, [comparison], [second]))
    if any((kind is str) != (other is str) for other in others):
        raise ConfigurationError(
            f"--where: {text} compares a text with a number",
            remedy="write a text in quotes, and a number without; `fieldkit columns` lists the units of columns",
        )
    if kind is str and type(comparison) in _ORDER:
        raise ConfigurationError(f"--where: {text}: texts have no order", remedy="use ==, != or in")


def _type(node: ast.expr, types: Mapping[str, type]) -> type:
    """Return the type of a column or a constant."""
    match node:
        case ast.Name(id=name):
            if name in types:
                return types[name]
            if name in _BOOLEANS:
                return bool
            raise ConfigurationError(
                f"--where: there is no column {name!r}",
                remedy=did_you_mean(name, types, "fieldkit columns lists them; a text needs quotes"),
            )
        case ast.Constant(value=bool() | int() | float() | str() as value):
            return type(value)
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float())):
            return float
    raise _not_allowed(node)


_BOOLEANS: Final = {"true": True, "false": False}


def _not_allowed(node: ast.expr) -> ConfigurationError:
    return ConfigurationError(f"--where: {ast.unparse(node)!r} is not a comparison of columns", remedy=_EXAMPLE)


def _truth(node: ast.expr, rows: Repeats) -> Truth:
    """Return the result of a condition for each row."""
    match node:
        case ast.BoolOp(op=connective, values=conditions):
            truths = [_truth(condition, rows) for condition in conditions]
            true, false = (np.array([truth[index] for truth in truths]) for index in (0, 1))
            all_true, any_true, all_false, any_false = (
                np.asarray(combined)
                for combined in (true.all(axis=0), true.any(axis=0), false.all(axis=0), false.any(axis=0))
            )
            return Truth(all_true, any_false) if isinstance(connective, ast.And) else Truth(any_true, all_false)
        case ast.UnaryOp(operand=condition):
            truth = _truth(condition, rows)
            return Truth(truth.false, truth.true)
        case ast.Compare(left=left, ops=operators, comparators=others):
            terms = [left, *others]
            truths = [
                _comparison(first, comparison, second, rows)
                for first, comparison, second in zip(terms, operators, others, strict=False)
            ]
            return Truth(
                np.all([truth.true for truth in truths], axis=0), np.any([truth.false for truth in truths], axis=0)
            )
    values, missing = _values(node, rows)
    return Truth(~missing & (values != 0), ~missing & (values == 0))


def _comparison(first: ast.expr, comparison: ast.cmpop, second: ast.expr, rows: Repeats) -> Truth:
    """Return the result of one comparison for each row."""
    values, missing = _values(first, rows)
    if isinstance(comparison, _MEMBERSHIP) and isinstance(second, ast.List | ast.Tuple | ast.Set):
        result = np.zeros(len(rows), np.bool_)
        for element in second.elts:
            others, others_missing = _values(element, rows)
            result |= np.asarray(values == others, np.bool_) & ~others_missing
        if isinstance(comparison, ast.NotIn):
            result = ~result
    else:
        others, others_missing = _values(second, rows)
        missing = missing | others_missing
        result = np.asarray((_ORDER | _EQUALITY)[type(comparison)](values, others), np.bool_)
    return Truth(~missing & result, ~missing & ~result)


def _values(node: ast.expr, rows: Repeats) -> tuple[NDArray[Any], Mask]:
    """Return the values of a column or a constant, and a mask of the rows in which they are missing."""
    if isinstance(node, ast.Name) and node.id in rows.texts:
        texts = rows.texts[node.id]
        return texts, np.asarray(texts == "", np.bool_)
    if isinstance(node, ast.Name) and node.id in rows.numbers:
        numbers = rows.numbers[node.id]
        return numbers, np.isnan(numbers)
    value = _BOOLEANS[node.id] if isinstance(node, ast.Name) else _constant(node)
    return np.full(len(rows), value, np.object_ if isinstance(value, str) else np.float64), np.zeros(
        len(rows), np.bool_
    )


def _constant(node: ast.expr) -> str | float:
    """Return a constant; an integer beyond the range of a float is infinite, as the literal `1e400` is."""
    value: str | float = ast.literal_eval(node)
    if isinstance(value, str):
        return value
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf
