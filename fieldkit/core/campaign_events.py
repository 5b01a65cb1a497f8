"""Events of a campaign."""

from dataclasses import dataclass

from typing_extensions import override

from fieldkit.core.events import Event, Words
from fieldkit.core.units import TimeEstimate, format_bytes


@dataclass(frozen=True)
class CampaignPlanned(Event):
    """The remaining work of a campaign.

    Attributes:
        name: Name of the campaign.
        trials: Names of the remaining trials, in order.
        done: Number of finished trials.
        total: Number of all trials.
        walk_m: Distance over which robots must be carried, in metres.
        left_s: Estimated duration of the remaining trials.
        needed_bytes: Disk space on this machine that the evidence may need.
        free_bytes: Free disk space on this machine.
        left_most_s: Upper estimate of `left_s`. It does not include repeats that must be run again.
    """

    name: str
    trials: tuple[str, ...]
    done: int
    total: int
    walk_m: float
    left_s: float
    needed_bytes: int
    free_bytes: int
    left_most_s: float = 0.0

    @property
    @override
    def words(self) -> Words:
        done_text = _done_text(self.done, self.total)
        if not self.trials:
            return ((done_text, ""),)
        names = (f"\n{number:5d}  {name}" for number, name in enumerate(self.trials, start=self.done + 1))
        disk = f"{format_bytes(self.needed_bytes)} of disk ({format_bytes(self.free_bytes)} free)"
        duration = TimeEstimate(self.left_s, self.left_most_s)
        condition = " if links fail" if not duration.is_certain else ""
        cost = f"{self.walk_m:.0f} m to walk with robots, about {duration}{condition}; at most {disk}"
        return ((f"{done_text}; {cost}{''.join(names)}", ""),)


@dataclass(frozen=True)
class CampaignTrial(Event):
    """A campaign starts a trial.

    Attributes:
        trial: Name of the trial.
        number: Its number in the order of execution, from 1.
        total: Number of all trials.
    """

    trial: str
    number: int
    total: int

    @property
    @override
    def words(self) -> Words:
        return ((f"{self.part}: {self.trial}", "bold"),)

    @property
    @override
    def part(self) -> str:
        return f"trial {self.number} of {self.total}"


@dataclass(frozen=True)
class CampaignWent(Event):
    """A trial of a campaign is finished, or was postponed.

    Attributes:
        trial: Name of the trial.
        done: Number of finished trials.
        total: Number of all trials.
        left_s: Estimated remaining time.
        left_most_s: Upper estimate of the remaining time. It does not include repeats that must be run again.
    """

    trial: str
    done: int
    total: int
    left_s: float
    left_most_s: float = 0.0

    @property
    @override
    def words(self) -> Words:
        left_text = f", about {TimeEstimate(self.left_s, self.left_most_s)} left" if self.done < self.total else ""
        return ((f"{_done_text(self.done, self.total)}{left_text}", ""),)


@dataclass(frozen=True)
class CampaignEnded(Event):
    """The campaign is finished or was stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished trials.
        total: Number of all trials.
    """

    ends_progress = True

    folder: str
    done: int
    total: int

    @property
    @override
    def words(self) -> Words:
        hint = "" if self.done == self.total else "; to continue, run the same command again"
        return ((f"{_done_text(self.done, self.total)}{hint}: {self.folder}", "bold"),)


def _done_text(done: int, total: int) -> str:
    return f"campaign: {done} of {total} trials are done"
