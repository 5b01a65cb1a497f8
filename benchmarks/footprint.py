"""Memory and processor time of processes, from the kernel's counters."""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

_KB: Final = 1024
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Memory:
    """Memory of a process tree.

    Attributes:
        own_bytes: Unique set size (USS): anonymous pages, each counted once, and file pages that one process has.
        pss_bytes: Proportional set size: own pages, and one n-th of each page that n processes of this machine share.
    """

    own_bytes: int
    pss_bytes: int

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the memory of the processes of `tree`.

        Forks share anonymous pages, which are assumed to belong only to this tree. A file page, of a program or a
        library, counts as own if only one process has it.
        """
        rollups = [_smaps(process) for process in tree(pid)]
        own_kb = sum(rollup["Pss_Anon"] + rollup["Private_Clean"] for rollup in rollups)
        return cls(own_kb * _KB, sum(rollup["Pss"] for rollup in rollups) * _KB)


def cpu_s(pid: int) -> float:
    """Return the processor time of the processes of `tree` and of their terminated and awaited children."""
    total_s = 0.0
    for process in tree(pid):
        total_s += sum(_scheduled_ns(thread) for thread in Path(f"/proc/{process}/task").iterdir()) / 1e9
        # proc(5), fields 16 and 17: whole ticks of awaited children. Field 2, the name in parentheses, may contain
        # spaces.
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        total_s += sum(map(int, fields[13:15])) / _TICKS_PER_S
    return total_s


def tree(pid: int) -> Iterator[int]:
    """Yield a process and its descendants, without children that a thread other than the main thread started."""
    yield pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split():
        yield from tree(int(child))


def _smaps(pid: int) -> dict[str, int]:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    return {name: int(kb) for name, kb in re.findall(r"^(\w+): +(\d+) kB$", text, re.MULTILINE)}


def _scheduled_ns(thread: Path) -> int:
    return int((thread / "schedstat").read_text(encoding="ascii").split()[0])
