"""Send a file that lies on a robot, or bytes that it makes up, from one robot to another with netcat."""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config.schema import Bytes, Field, Int
from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.core.units import format_bytes
from fieldkit.measure.evidence import reading
from fieldkit.remote import jobs
from fieldkit.remote.command import quote
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import FileName, Nest, Step, View
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.steps.scene import GOOD_BIT_S, Announce, Need, Planned, RecordedFile, Refusal, Said, Scene

FILE: Final = "send.bin"
"""What is sent, in the attempt's folder."""

# Park and Miller's generator (1988, Communications of the ACM 31, 10), whose numbers any awk holds exactly, as text:
# bytes that look like no others, so that captures tell packets apart, and the same for the same seed.
_MAKE: Final = (
    "BEGIN { x = seed; for (n = 0; n < bytes; n += 64) { "
    'line = ""; for (i = 0; i < 8; i++) { x = (x * 16807) % 2147483647; line = line sprintf("%08x", x) } '
    'printf "%s", substr(line, 1, bytes - n) } }'
)
_WHOLE_PATH: Final = 'case $1 in /*) ;; *) set -- "$HOME/$1" "$2" ;; esac; '
_COPY: Final = f'{_WHOLE_PATH}exec cp -- "$1" "$2"'
_COUNT: Final = f'{_WHOLE_PATH}exec wc -c <"$1"'
_SIZE: Final = re.compile(r"[0-9]{1,15}")

_MADE_BYTES_PER_S: Final = 1e6
"""How fast a small robot makes bytes up, or copies them: busybox' awk makes 1.5 MB/s on a laptop of 2026."""

_ALIKE: Final = 2.0
"""By what factor the size of a file may be another than the procedure says."""


class SendStep(TransferStep):
    """A transfer of a file without a recording before it.

    Attributes:
        size: How many bytes are made up; where a file is sent, about how large it is.
        file: The file, by its whole path or from the user's home on; None for bytes made up.
        seed: Of the bytes made up.
        into: The file written by the receiver.
    """

    size: Bytes
    file: Annotated[str, Field(pattern=r"^[^\x00\n]{1,400}$")] | None = None
    seed: Annotated[Int, Field(gt=0, lt=2**31 - 1)] = 1
    into: FileName = "recv.bin"

    def misplaced(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:  # noqa: ARG002 (it fits anywhere)
        """See `Step.misplaced`."""
        return None

    def _sent(self, scene: Scene) -> RecordedFile:  # noqa: ARG002 (nobody records it)
        return RecordedFile(self.sender, self.own_name(FILE), self.size)

    def _refused_file(self, scene: Scene) -> Iterator[Refusal]:  # noqa: ARG002 (of a recorder, of which there is none)
        return iter(())

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        yield self._make(scene)
        yield from super().commands(scene)

    def _make(self, scene: Scene) -> Planned:
        """Return the job that puts what is sent into the attempt's folder, from where it is fetched too."""
        made = self._sent(scene).name
        if self.file is None:
            argv = ("awk", "-v", f"seed={self.seed}", "-v", f"bytes={self.size:.0f}", _MAKE)
        else:
            argv = ("sh", "-c", _COPY, "sh", self._path, made)
        job = Job(
            folder=scene.folder,
            name=self.own_name("make"),
            argv=argv,
            limit_s=30.0 + self.size / _MADE_BYTES_PER_S,
            log=self._log,
            stdout=made if self.file is None else None,
        )
        return Planned(self.sender, job, program="awk" if self.file is None else "cp")

    @property
    def _path(self) -> str:
        return (self.file or "").removeprefix("~/")

    @property
    def _log(self) -> str:
        return self.own_name(f"{self.sender}-make.log")

    def needs(self, scene: Scene) -> Iterator[Need]:  # noqa: ARG002 (the same for every scene)
        """See `Step.needs`: the file."""
        if self.file is not None:
            yield Need(self.sender, f"file {self.file}", ("sh", "-c", _COUNT, "sh", self._path, "-"), self._judged)

    def _judged(self, answer: Said) -> tuple[Verdict, str, str]:
        """Return whether the file is there, and as large as the procedure says."""
        if not answer.ok or not _SIZE.fullmatch(answer.text.strip()):
            remedy = f"scp {quote((self.file or '',))} to it, or correct file: in the procedure"
            return Verdict.FAIL, answer.text, remedy
        size_bytes = int(answer.text)
        if not size_bytes:
            return Verdict.FAIL, "it is empty", "name a file with content"
        if not self.size / _ALIKE <= size_bytes <= self.size * _ALIKE:
            what = f"{format_bytes(size_bytes)}, and the procedure says {format_bytes(self.size)}"
            return Verdict.WARN, what, f"write size: {size_bytes}B in the procedure, by which room is reserved"
        return Verdict.OK, format_bytes(size_bytes), ""

    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """See `Step.prepare`: there is something to send, and the listener is up."""
        make = self._make(scene)
        if (code := jobs.run(testbed.shells[self.sender], make.job)) != 0:
            why = f"{make.program} ended with exit code {code}"
            raise scene.failure(make, f"what is to be sent could not be made: {why}")
        return super().prepare(scene, testbed)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return (*super().files(), self.own_name(FILE), self._log)

    def bytes_left(self, scene: Scene, role: Role) -> float:  # noqa: ARG002 (the same for every scene)
        """See `Step.bytes_left`."""
        return self.size if role in self.roles() else 0.0

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: what was sent is there, too, and whole."""
        made = self._sent(view.scene).name
        size_bytes = view.evidence.known(reading.size, made)
        if size_bytes is None:
            yield f"{made} is missing"
        elif self.file is None and size_bytes != round(self.size):
            yield f"{made} has {size_bytes} bytes, {self.size:.0f} were to be made up"
        yield from super().problems(view)

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return super().expected_s(protocol) + self.size * (8 / GOOD_BIT_S + 1 / _MADE_BYTES_PER_S)
