"""Events of a sweep of simulations."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SweepPlanned:
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


@dataclass(frozen=True)
class SweepRunEnded:
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


@dataclass(frozen=True)
class SweepEnded:
    """A sweep is finished or was stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished runs.
        failed: Number of failed runs that are not tried again.
        total: Number of all runs.
    """

    folder: str
    done: int
    failed: int
    total: int
