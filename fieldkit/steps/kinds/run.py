"""Run any program on a robot, and read columns from its output."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Final

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.named_programs import NamedProgram
from fieldkit.config.schema import AfterValidator, Bool, Bytes, Duration, Field, Int, Number, Strict
from fieldkit.core.columns import Column, Figure, Kind, Measured, Value, cell_text
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import host, program_output
from fieldkit.remote import jobs, programs
from fieldkit.remote.jobs import Job
from fieldkit.steps import arguments
from fieldkit.steps.base import FileName, Step
from fieldkit.steps.capabilities import Summarizes, UsesSpace
from fieldkit.steps.scene import Announce, Planned, PutProgram, Scene
from fieldkit.steps.view import View

_SHELL_OPERATORS: Final = frozenset({"|", "||", "&", "&&", ";", "<", ">", ">>", "2>", "2>&1", "&>"})
"""Words that are almost certainly mistakes in `command`; if they are intended, they can be written in `argv`."""

_Word = Annotated[str, Field(pattern=r"^[^\x00]*$")]


def _checked_path(text: str) -> str:
    if reason := program_output.path_error(text):
        raise schema.validation_error(f"{text!r} is not a valid JMESPath: {reason}")
    return text


def _checked_expression(text: str) -> str:
    if reason := program_output.expression_error(text):
        raise schema.validation_error(f"{text!r} is not a regular expression (RE2) with one group: {reason}")
    return text


class PrintedColumn(Strict):
    """A column that is read from the output of a program.

    Attributes:
        name: Name of the column.
        unit: Any unit, such as `V`, `dBm` or `%`; `text`, `bool` or `count` for values without a unit.
        meaning: Meaning of the values, for `fieldkit columns`.
        path: Location of the value in JSON output, such as `battery.cells[0].mV`: a [JMESPath](https://jmespath.org).
            If a key occurs twice, the last one is used.
        expression: Instead of `json`, a regular expression ([RE2](https://github.com/google/re2/wiki/Syntax)) with
            one group, whose first match is the value. `^` and `$` match the start and the end of a line.
        optional: Whether the value may be missing in a valid repeat.
        label: Label in tables and figures, instead of its name.
    """

    name: Annotated[
        str,
        schema.pattern_field(
            r"^[a-z][a-z0-9_]{0,40}$", "a name of at most 41 lower-case letters, digits and _, with a letter first"
        ),
    ]
    unit: Annotated[
        str,
        schema.pattern_field(
            r"^[^\s,;\"][^,;\"\x00-\x1f]{0,15}$", "a unit of 1 to 16 characters, without , ; and quotes"
        ),
    ]
    meaning: Annotated[str, Field(max_length=300)] = ""
    path: Annotated[str, AfterValidator(_checked_path)] | None = Field(default=None, alias="json")
    expression: Annotated[str, AfterValidator(_checked_expression)] | None = Field(default=None, alias="regex")
    optional: Bool = False
    label: Annotated[str, Field(max_length=40)] = ""

    @schema.model_validator(mode="after")
    def _has_one_source(self) -> "PrintedColumn":
        if (self.path is None) == (self.expression is None):
            raise schema.validation_error(f"the column {self.name} needs either json: or regex:")
        return self

    @property
    def column(self) -> Column:
        """The column as it is declared."""
        source = f"at {self.path} in the JSON output" if self.path else "by a regular expression in the output"
        column = Column(self.name, self.unit, self.meaning or f"Value {source} of a program.")
        kind = {bool: Kind.FLAG, str: Kind.WORDS}.get(column.type, Kind.MEDIAN)
        return replace(column, figure=Figure(self.label or self.name, kind))

    def value(self, view: View, file: str) -> Value:
        """Return its value in an output file.

        Raises:
            EvidenceError: The file has no valid value.
        """
        if self.path is not None:
            content = view.evidence.read(program_output.at_path, file, self.path)
        else:
            content = view.evidence.read(program_output.by_expression, file, self.expression or "")
        return program_output.to_column_value(self.column, content)


class Bounds(Strict):
    """Bounds of a value. If a value is outside of them, the repeat is void.

    Attributes:
        min: Minimum.
        max: Maximum.
    """

    min: Number | Int | None = None
    max: Number | Int | None = None

    def problem(self, value: Value) -> str | None:
        """Return the reason why a value is out of bounds; None if it is within bounds, or is a text."""
        if isinstance(value, str):
            return None
        if self.min is not None and value < self.min:
            return f"less than {self.min:g}"
        return f"more than {self.max:g}" if self.max is not None and value > self.max else None


class Expected(Strict):
    """Conditions for exit code and values. If one of them is not met, the repeat is void.

    Attributes:
        code: Permitted exit codes, 0 to 125.
        values: Bounds of columns, by name.
    """

    code: Annotated[tuple[Annotated[Int, Field(ge=0, le=125)], ...], Field(min_length=1)] = (0,)
    values: dict[str, Bounds] = Field(default_factory=dict)


class RunStep(Step, UsesSpace, Summarizes):
    """Runs a program on a robot, keeps its output, and reads columns from the output.

    The program is found in the PATH of a session without a terminal, or by its absolute path; it runs in the folder
    of the attempt. No shell is involved; to use one, write `sh -c '...'`. At most 1 MiB of standard output and 1 MiB
    of standard error are kept; a program that prints more is stopped. Writes `run.txt` and `ROLE-run.log`.

    Variables in `command` and `argv`: `{address.ROLE}` is the address of a robot on the radio, `{distance}` the
    distance as typed (`30ft`), `{repeat}` the number of the repeat of its protocol, from 1, and `{put}` the path of
    the copied program. `{{distance}}` is the text `{distance}`; other braces, and `${distance}`, are not changed, but
    a name that resembles one of these is refused. Inside a [`for:` loop](reference/procedure.md#for), which
    replaces its own variables first, write `{{distance}}` for the variable `{distance}`.

    Attributes:
        robot: Role of the robot on which it runs.
        command: The command, which is split into words as by a shell. It may contain variables, but no shell
            operators such as a pipe.
        argv: The command as a list of words, instead of `command`.
        put: A program of the lab, at most 8.4 MB, which is copied to the robot before the first step: a path relative
            to the folder of the procedure or, if it does not exist there, of the lab; links must not point outside.
            `{put}` is its path on the robot. In `trial.yaml` it is a mapping with the keys below; in a procedure it
            is a path.
        takes: Approximate duration, for the estimate of the remaining time.
        limit: Maximum duration. A program that runs longer is stopped, and the repeat is void.
        output: File for its standard output.
        prints: Approximate size of the output, for the estimate of disk space.
        figures: Columns of `trial.csv`, each read from the output.
        expect: Conditions; if one of them is not met, the repeat is void.
    """

    robot: Role
    command: _Word = ""
    argv: tuple[_Word, ...] = ()
    put: NamedProgram | None = Field(default=None, exclude_if=schema.is_empty)
    takes: Duration = 1.0
    limit: Annotated[Duration, Field(gt=0)] = 60.0
    output: FileName = "run.txt"
    prints: Bytes = 10_000.0
    figures: tuple[PrintedColumn, ...] = Field(default=(), alias="columns")
    expect: Expected = Field(default_factory=Expected)  # a plain default would be built at every import

    @schema.model_validator(mode="after")
    def _can_be_run(self) -> "RunStep":
        if bool(self.command.strip()) == bool(self.argv):
            raise schema.validation_error("the step needs either command: or argv:")
        try:
            words = self.words
        except ValueError as error:
            raise schema.validation_error(
                f"{self.command!r} cannot be split into words: {error}", "command"
            ) from None
        self._check_roles()
        if operator := next((word for word in shlex.split(self.command) if word in _SHELL_OPERATORS), None):
            raise schema.validation_error(
                f"{operator} is a shell operator, but no shell runs this command; write sh -c '...'", "command"
            )
        if not words[0]:
            raise schema.validation_error(
                "the program, which is the first word, is empty", "argv" if self.argv else "command"
            )
        self._check_variables()
        return self

    def _check_variables(self) -> None:
        for index, word in enumerate(self.words):
            if reason := arguments.problem(word, has_program=self.put is not None):
                raise schema.validation_error(reason, *(("argv", index) if self.argv else ("command",)))
        program = self.words[0]
        if arguments.depends_on_repeat(program):
            reason = f"the name of the program must not depend on a variable, but {program} does; use an argument"
            raise schema.validation_error(reason, "argv" if self.argv else "command")
        if self.put is None:
            return
        if not any(arguments.PUT in arguments.names(word) for word in self.words):
            reason = f"the command does not run {self.put.name}: write {{put}} in the command for its path"
            raise schema.validation_error(reason, "put")
        if program == f"{{{arguments.PUT}}}" and not self.put.executable:
            reason = f"{self.put.file} is not executable: chmod +x it, or name its interpreter: python3 {{put}}"
            raise schema.validation_error(reason, "put")

    def _check_roles(self) -> None:
        try:
            self.roles()
        except ValueError as error:
            raise schema.validation_error(
                f"an address needs a valid role, as in {{address.receiver}}: {error}"
            ) from None

    @schema.model_validator(mode="after")
    def _has_valid_columns(self) -> "RunStep":
        names = [column.name for column in self.figures]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise schema.validation_error(f"there is already a column {name}", "columns", index, "name")
        for name in self.expect.values:
            if name not in names:
                raise schema.validation_error(f"there is no column {name}", "expect", "values", name)
        return self

    @property
    def words(self) -> tuple[str, ...]:
        """The words of the command, with variables."""
        return self.argv or tuple(shlex.split(self.command))

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:

        def address(role: str) -> str:
            return scene.robot(Role(role)).address

        put, values = self._copied_program, dict[str, str]()
        if put is not None:
            values[arguments.PUT] = put.at
        if scene.placement is not None:
            values["distance"] = scene.placement.distance.label
        if scene.repeat is not None:
            values["repeat"] = str(scene.repeat)
        argv = [arguments.fill_in(word, values, address) for word in self.words]
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name("run"),
            argv=tuple(argv),
            limit_s=self.limit,
            log=self._log,
            stdout=self._output,
            output_limit_bytes=program_output.MAX_OUTPUT_BYTES,
        )
        remedy = f"install {argv[0]}, or correct the command of this run in the procedure"
        # The preflight checks search for the program; a copied program does not exist on the robot yet.
        program = "sh" if self.words[0] == f"{{{arguments.PUT}}}" else argv[0]
        yield Planned(self.robot, job, program=program, remedy=remedy, put=put)

    @property
    def _copied_program(self) -> PutProgram | None:
        if self.put is None:
            return None
        return PutProgram(self.robot, self.put, programs.path(self.prefixed_name("run"), self.put.name))

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        (planned,) = self.jobs(scene)
        announce(self._program_name, self.takes)
        shell = testbed.shells[self.robot]
        with shell.silence(self.limit):
            code = jobs.run(shell, planned.job)
        if code not in self.expect.code:
            raise RobotError(
                f"{self._program_name} ended with exit code {code}",
                where=scene.robot(self.robot).name,
                remedy=f"see {self._log} and {self._output} of this repeat",
            )

    cross_checks = (
        CrossCheck(
            quantity="output of a program of the lab",
            columns=("*",),
            source="the step's output file",
            against=(),
            tolerance="fieldkit cannot check the program; `expect:` bounds its values",
            outcome=CheckOutcome.UNCHECKED,
        ),
    )

    @override
    def roles(self) -> frozenset[Role]:
        argument_roles = {Role(role) for word in self.words for role in arguments.roles(word)}
        return frozenset({self.robot}) | argument_roles

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.takes

    @override
    def files(self) -> tuple[str, ...]:
        return (self._output, self._log)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        return self.prints if role == self.robot else 0.0

    @property
    def _program_name(self) -> str:
        """Name of the program in messages."""
        return self.put.name if self.put and self.words[0] == f"{{{arguments.PUT}}}" else self.words[0]

    @property
    def _log(self) -> str:
        return self.prefixed_name(f"{self.robot}-run.log")

    @property
    def _output(self) -> str:
        return self.prefixed_name(self.output)

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns that the procedure declares."""
        return tuple(column.column for column in self.figures)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason for a wrong exit code, unreadable output, and each missing value or value out of bounds."""
        after = view.evidence.read_or_none(host.read_state, host.after_file(self.robot))
        termination = (after.terminations or {}).get(self.prefixed_name("run")) if after else None
        if termination is not None and termination.code is not None and termination.code not in self.expect.code:
            yield f"{view.scene.robot(self.robot).name}: {self._program_name} ended with exit code {termination.code}"
        try:
            view.evidence.read(program_output.text, self._output)
        except EvidenceError as error:
            yield f"{self._output}: {error.what}"
            return
        measured = self.measure(view)
        for column in self.figures:
            if column.name in measured.missing and not column.optional:
                yield f"{self._output}: no {column.name}: {measured.missing[column.name]}"
            elif column.name in measured.values and (bounds := self.expect.values.get(column.name)):
                value = measured.values[column.name]
                if reason := bounds.problem(value):
                    yield f"{self._output}: {column.name} is {value}, {reason}"

    @override
    def measure(self, view: View) -> Measured:
        values, missing = dict[str, Value](), dict[str, str]()
        for column in self.figures:
            try:
                values[column.name] = column.value(view, self._output)
            except EvidenceError as error:
                missing[column.name] = error.what
        return Measured(values, missing)

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        for column in self.figures:
            if column.name in values:
                value = values[column.name]
                value_text = f"{value:.4g}" if isinstance(value, float) else cell_text(value)
                unit = "" if column.unit in {"text", "bool", "count", "hash"} else f" {column.unit}"
                yield f"{column.label or column.name} {value_text}{unit}"
