"""Run any program on a robot, and make columns of what it prints."""

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Bool, Bytes, Duration, Field, Int, Number, Strict
from fieldkit.core.columns import Column, Figure, Kind, Measured, Value, cell
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import host, printed
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import FileName, Step, View
from fieldkit.steps.scene import Announce, Planned, Scene

_ADDRESS: Final = re.compile(r"\{address\.(?P<role>[^{}]*)\}")

# Lets no more than $1 bytes of either output through, whatever the program says; its exit code is the program's.
_BOUNDED: Final = (
    'n=$1; shift; exec 5>&1 6>&2; exit "$( { { { "$@" 3>&- 5>&- 6>&-; echo $? >&3; } 2>&1 >&4 4>&- 5>&- 6>&- '
    '| head -c "$n" >&6; } 4>&1 | head -c "$n" >&5; } 3>&1 )"'
)

_OF_SHELLS: Final = frozenset({"|", "||", "&", "&&", ";", "<", ">", ">>", "2>", "2>&1", "&>"})
"""Words that a program gets by mistake alone; who means one writes `argv`."""

_Word = Annotated[str, Field(pattern=r"^[^\x00]*$")]


def _is_path(text: str) -> str:
    if why := printed.problem_of_path(text):
        raise schema.complaint(f"{text!r} is no path into JSON (JMESPath): {why}")
    return text


def _is_expression(text: str) -> str:
    if why := printed.problem_of_expression(text):
        raise schema.complaint(f"{text!r} is no regular expression (RE2) with one group: {why}")
    return text


class PrintedColumn(Strict):
    """A column, and where its value stands in what a program prints.

    Attributes:
        name: Its name.
        unit: Unit of its values; `text`, `bool` or `count` where they have none.
        meaning: What it says.
        path: Where it stands in JSON (`json`), JMESPath.
        expression: What prints it (`regex`), RE2 with one group; the first match counts.
        optional: Whether the program may leave it out: it is then empty, and the repeat valid.
        label: What people call it; empty for its name.
    """

    name: Annotated[
        str,
        schema.shaped(
            r"^[a-z][a-z0-9_]{0,40}$", "a name: small letters, digits and _, a small letter first, 41 in all"
        ),
    ]
    unit: Annotated[
        str,
        schema.shaped(r"^[^\s,;\"][^,;\"\x00-\x1f]{0,15}$", "a unit: 1 to 16 characters, none of them , ; or quotes"),
    ]
    meaning: Annotated[str, Field(max_length=300)] = ""
    path: Annotated[str, AfterValidator(_is_path)] | None = Field(default=None, alias="json")
    expression: Annotated[str, AfterValidator(_is_expression)] | None = Field(default=None, alias="regex")
    optional: Bool = False
    label: Annotated[str, Field(max_length=40)] = ""

    @schema.model_validator(mode="after")
    def _stands_somewhere(self) -> "PrintedColumn":
        if (self.path is None) == (self.expression is None):
            raise schema.complaint(f"the column {self.name} stands at json: or is found by regex:, one of them")
        return self

    @property
    def column(self) -> Column:
        """The column as it is declared."""
        how = f"at {self.path} of the JSON" if self.path else "by a regular expression in the text"
        column = Column(self.name, self.unit, self.meaning or f"Found {how} that a program printed.")
        kind = {bool: Kind.FLAG, str: Kind.WORDS}.get(column.type, Kind.MEDIAN)
        return replace(column, figure=Figure(self.label or self.name, kind))

    def value(self, view: View, file: str) -> Value:
        """Return its value in what was printed.

        Raises:
            EvidenceError: There is none.
        """
        if self.path is not None:
            found = view.evidence.read(printed.at_path, file, self.path)
        else:
            found = view.evidence.read(printed.by_expression, file, self.expression or "")
        return printed.value(self.column, found)


class Bounds(Strict):
    """What a value must be for a repeat to be valid.

    Attributes:
        min: No less.
        max: No more.
    """

    min: Number | Int | None = None
    max: Number | Int | None = None

    def problem(self, value: Value) -> str | None:
        """Return why a value is not within, None where it is."""
        if isinstance(value, str):
            return None
        if self.min is not None and value < self.min:
            return f"less than {self.min:g}"
        return f"more than {self.max:g}" if self.max is not None and value > self.max else None


class Expected(Strict):
    """What a program must do for a repeat to be valid.

    Attributes:
        code: Exit codes, one of them.
        values: Bounds of columns.
    """

    code: Annotated[tuple[Annotated[Int, Field(ge=0, le=125)], ...], Field(min_length=1)] = (0,)
    values: dict[str, Bounds] = Field(default_factory=dict)


class RunStep(Step):
    """A program on a robot, what it prints kept in a file, and columns made of that.

    Attributes:
        robot: Whose.
        command: The command, split into words as a shell does; no shell sees it.
        argv: The command as words, in place of `command`.
        takes: About how long it takes.
        limit: When it is ended.
        output: File for what it prints.
        prints: About how much that is, in bytes.
        figures: What is read there (`columns`).
        expect: What must be so for a repeat to be valid.
    """

    robot: Role
    command: _Word = ""
    argv: tuple[_Word, ...] = ()
    takes: Duration = 1.0
    limit: Annotated[Duration, Field(gt=0)] = 60.0
    output: FileName = "run.txt"
    prints: Bytes = 10_000.0
    figures: tuple[PrintedColumn, ...] = Field(default=(), alias="columns")
    expect: Expected = Field(default_factory=Expected)  # made, it would be built for whoever names no such step

    @schema.model_validator(mode="after")
    def _can_be_run(self) -> "RunStep":
        if bool(self.command.strip()) == bool(self.argv):
            raise schema.complaint("a program is named by command: or by argv:, one of them")
        try:
            words = self.words
        except ValueError as error:
            raise schema.complaint(f"{self.command!r} cannot be split into words: {error}", "command") from None
        self._check_roles()
        if alien := next((word for word in shlex.split(self.command) if word in _OF_SHELLS), None):
            raise schema.complaint(f"no shell sees this command, and {alien} is a shell's: sh -c '...'", "command")
        if not words[0]:
            raise schema.complaint("the first word, the program, is empty", "argv" if self.argv else "command")
        return self

    def _check_roles(self) -> None:
        try:
            self.roles()
        except ValueError as error:
            raise schema.complaint(f"an address is that of a role, {{address.receiver}}: {error}") from None

    @schema.model_validator(mode="after")
    def _has_columns(self) -> "RunStep":
        names = [column.name for column in self.figures]
        for at, name in enumerate(names):
            if name in names[:at]:
                raise schema.complaint(f"a column {name} is there already", "columns", at, "name")
        for name in self.expect.values:
            if name not in names:
                raise schema.complaint(f"there is no column {name} to expect something of", "expect", "values", name)
        return self

    @property
    def words(self) -> tuple[str, ...]:
        """The command as words, addresses not filled in."""
        return self.argv or tuple(shlex.split(self.command))

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""

        def address(match: re.Match[str]) -> str:
            return scene.robot(Role(match["role"])).address

        argv = [_ADDRESS.sub(address, word) for word in self.words]
        job = Job(
            folder=scene.folder,
            name=self.own_name("run"),
            argv=("sh", "-c", _BOUNDED, "sh", str(printed.MOST_BYTES), *argv),
            limit_s=self.limit,
            log=self._log,
            stdout=self._output,
        )
        remedy = f"install {argv[0]}, or correct the command of this run in the procedure"
        yield Planned(self.robot, job, program=argv[0], remedy=remedy)

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        (planned,) = self.commands(scene)
        announce(planned.program, self.takes)
        shell = testbed.shells[self.robot]
        with shell.silence(self.limit):
            code = jobs.run(shell, planned.job)
        if code not in self.expect.code:
            raise RobotError(
                f"{planned.program} ended with exit code {code}",
                where=scene.robot(self.robot).name,
                remedy=f"see {self._log} and {self._output} of this repeat",
            )

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        named = {Role(match["role"]) for word in self.words for match in _ADDRESS.finditer(word)}
        return frozenset({self.robot}) | named

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """See `Step.expected_s`."""
        return self.takes

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("a run",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return (self._output, self._log)

    def bytes_left(self, scene: Scene, role: Role) -> float:  # noqa: ARG002 (the same for every scene)
        """See `Step.bytes_left`."""
        return self.prints if role == self.robot else 0.0

    @property
    def _log(self) -> str:
        return self.own_name(f"{self.robot}-run.log")

    @property
    def _output(self) -> str:
        return self.own_name(self.output)

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`: what the procedure says."""
        return tuple(column.column for column in self.figures)

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: the program ended as it is to, and printed what is to be read, within bounds."""
        after = view.evidence.known(host.state, host.after(self.robot))
        ending = (after.endings or {}).get(self.own_name("run")) if after else None
        if ending is not None and ending.code is not None and ending.code not in self.expect.code:
            yield f"{view.scene.robot(self.robot).name}: {self.words[0]} ended with exit code {ending.code}"
        try:
            view.evidence.read(printed.text, self._output)
        except EvidenceError as error:
            yield f"{self._output}: {error.what}"
            return
        found = self.measure(view)
        for column in self.figures:
            if column.name in found.missing and not column.optional:
                yield f"{self._output}: no {column.name}: {found.missing[column.name]}"
            elif column.name in found.values and (bounds := self.expect.values.get(column.name)):
                value = found.values[column.name]
                if why := bounds.problem(value):
                    yield f"{self._output}: {column.name} is {value}, {why}"

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        values, missing = dict[str, Value](), dict[str, str]()
        for column in self.figures:
            try:
                values[column.name] = column.value(view, self._output)
            except EvidenceError as error:
                missing[column.name] = error.what
        return Measured(values, missing)

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        for column in self.figures:
            if column.name in values:
                value = values[column.name]
                shown = f"{value:.4g}" if isinstance(value, float) else cell(value)
                unit = "" if column.unit in {"text", "bool", "count", "hash"} else f" {column.unit}"
                yield f"{column.label or column.name} {shown}{unit}"
