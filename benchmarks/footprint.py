"""What processes take of a machine, as the kernel counts it: of memory, and of the processors' time."""

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
    """What a process tree takes, in bytes.

    Attributes:
        own: Pages that nobody outside the tree has, each counted once however many processes of the tree share it.
        pss: Own pages and, of a page that n processes of this machine share, one n-th each.
    """

    own: int
    pss: int

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the memory of a process and all its descendants.

        A fork shares anonymous pages, which no other tree can have; file pages, those of programs and libraries, are
        the tree's own where one process alone has them.
        """
        found = [_smaps(one) for one in tree(pid)]
        own_kb = sum(one["Pss_Anon"] + one["Private_Clean"] for one in found)
        return cls(own_kb * _KB, sum(one["Pss"] for one in found) * _KB)


def cpu_s(pid: int) -> float:
    """Return the processors' time of a process and all its descendants, with those that ended and were awaited."""
    found = 0.0
    for one in tree(pid):
        found += sum(_scheduled_ns(thread) for thread in Path(f"/proc/{one}/task").iterdir()) / 1e9
        # proc(5), fields 16 and 17: whole ticks of the awaited. Field 2, the name in parentheses, may hold spaces.
        fields = Path(f"/proc/{one}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        found += sum(map(int, fields[13:15])) / _TICKS_PER_S
    return found


def tree(pid: int) -> Iterator[int]:
    """Yield a process and all its descendants."""
    yield pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split():
        yield from tree(int(child))


def _smaps(pid: int) -> dict[str, int]:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    return {name: int(kb) for name, kb in re.findall(r"^(\w+): +(\d+) kB$", text, re.MULTILINE)}


def _scheduled_ns(thread: Path) -> int:
    return int((thread / "schedstat").read_text(encoding="ascii").split()[0])
