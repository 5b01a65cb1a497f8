"""Events of a sweep of simulations."""

from dataclasses import dataclass
from typing import Final

from typing_extensions import override

from fieldkit.core.events import Event, Words
from fieldkit.core.units import format_count

_INDENT: Final = " " * 8


@dataclass(frozen=True)
class SweepPlanned(Event):
    """A sweep of simulations starts or continues.

    Attributes:
        folder: Its folder.
        done: Number of runs that were finished before.
        total: Number of all runs.
        settings: Number of combinations of settings.
        seeds: Number of seeds of each combination.
    """

    folder: str
    done: int
    total: int
    settings: int
    seeds: int

    @property
    @override
    def words(self) -> Words:
        done = f"; {self.done:,} are done" if self.done else ""
        factors = f"{format_count(self.settings, 'setting')} with {format_count(self.seeds, 'seed')}"
        return ((f"{self.total:,} {'run' if self.total == 1 else 'runs'}: {factors}{done}", ""),)


@dataclass(frozen=True)
class SweepRunEnded(Event):
    """An attempt at a run of a sweep ended.

    Attributes:
        settings: Its settings: `policy=scheduled, window=10ms`.
        seed: Its seed.
        run: Name of its result.
        reason: Why it failed; empty if it is finished.
        remedy: What to do about the failure; may be empty.
        attempt: Number of the attempt, from 1.
        done: Number of finished runs.
        total: Number of all runs.
    """

    settings: str
    seed: int
    run: str
    reason: str
    remedy: str
    attempt: int
    done: int
    total: int

    @property
    @override
    def words(self) -> Words:
        if not self.reason:
            return ()  # there may be thousands of finished runs
        remedy = f"\n{_INDENT}remedy: {self.remedy}" if self.remedy else ""
        head = f"{self.settings}, seed {self.seed}: " if self.settings else f"seed {self.seed}: "
        return ((head, ""), (f"failed (attempt {self.attempt}): ", "red"), (self.reason, ""), (remedy, ""))


@dataclass(frozen=True)
class SweepEnded(Event):
    """A sweep is finished or was stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished runs.
        failed: Number of failed runs that are not tried again.
        total: Number of all runs.
    """

    ends_progress = True

    folder: str
    done: int
    failed: int
    total: int

    @property
    @override
    def words(self) -> Words:
        failed = f", {self.failed:,} failed" if self.failed else ""
        return ((f"{self.done:,} of {self.total:,} runs are done{failed}: {self.folder}", "bold"),)
