"""Base class of steps that run one program on one robot and parse its output: the simplest way to add a kind."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Measured, Value
from fieldkit.core.errors import EvidenceError, RobotError, describe_exception
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import host, program_output
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Step
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View


class ProgramStep(Step):
    """A step that runs one program on one robot and parses its output.

    A subclass declares its YAML keys as fields, `columns`, and two methods: `argv` and `parse`. The output is
    stored in a file of at most `program_output.MAX_OUTPUT_BYTES` bytes.

    Attributes:
        exit_codes: Exit codes of success; any other one makes the repeat void.
        limit_s: Seconds after which the program is stopped, which makes the repeat void.
        robot: The role of the robot that runs the program.
    """

    exit_codes: ClassVar[frozenset[int]] = frozenset({0})
    limit_s: ClassVar[float] = 60.0

    robot: Role

    @abstractmethod
    def argv(self, scene: Scene) -> Sequence[str]:
        """Return the command as a list of words; no shell interprets them.

        The address of the robot in another role is `scene.robot(role).address`.
        """

    @abstractmethod
    def parse(self, output: str) -> Mapping[str, Value]:
        """Return the values of columns by name, from the output of the program.

        A missing column makes the repeat void.

        Raises:
            ValueError: The output is not as expected. It may also raise LookupError or ArithmeticError; each of them
                makes the repeat void.
        """

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        argv = tuple(self.argv(scene))
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name(self.kind_name()),
            argv=argv,
            limit_s=self.limit_s,
            log=self._log,
            stdout=self._output,
            output_limit_bytes=program_output.MAX_OUTPUT_BYTES,
        )
        yield Planned(self.robot, job, program=argv[0], remedy=f"install {argv[0]}")

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        (planned,) = self.jobs(scene)
        announce(planned.program, self.expected_s(scene.protocol))
        shell = testbed.shells[self.robot]
        with shell.silence(planned.job.limit_s):
            code = jobs.run(shell, planned.job)
        if code not in self.exit_codes:
            raise RobotError(
                f"{planned.program} ended with exit code {code}",
                where=scene.robot(self.robot).name,
                remedy=f"see {self._log} and {self._output} of this repeat",
            )

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return 1.0

    @override
    def files(self) -> tuple[str, ...]:
        return (self._output, self._log)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if the program failed, and each reason for missing values with the names of its columns."""
        after = view.evidence.read_or_none(host.read_state, host.after_file(self.robot))
        termination = (after.terminations or {}).get(self.prefixed_name(self.kind_name())) if after else None
        if termination is not None and termination.code is not None and termination.code not in self.exit_codes:
            yield f"{view.scene.robot(self.robot).name}: {self.kind_name()} ended with exit code {termination.code}"
        names_by_reason: dict[str, list[str]] = {}
        for name, reason in self.measure(view).missing.items():
            names_by_reason.setdefault(reason, []).append(name)
        yield from (f"{self._output}: no {', '.join(names)}: {reason}" for reason, names in names_by_reason.items())

    @override
    def measure(self, view: View) -> Measured:
        columns = self.output_columns()
        try:
            values = self.parse(view.evidence.read(program_output.text, self._output))
        except EvidenceError as error:
            return Measured.all_missing(columns, error.what)
        except (ValueError, LookupError, ArithmeticError) as error:
            return Measured.all_missing(columns, f"the output is not as expected: {describe_exception(error)}")
        return Measured.from_optional(
            {column.name: values.get(column.name) for column in columns}, "the program did not print it"
        )

    @property
    def _output(self) -> str:
        return self.prefixed_name(f"{self.kind_name()}.txt")

    @property
    def _log(self) -> str:
        return self.prefixed_name(f"{self.robot}-{self.kind_name()}.log")
