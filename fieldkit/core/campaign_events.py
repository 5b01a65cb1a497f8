"""Events of a campaign."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CampaignPlanned:
    """The remaining work of a campaign.

    Attributes:
        name: Its name.
        trials: The remaining trials, in order.
        done: Number of finished trials.
        total: Number of all trials.
        walk_m: Distance over which robots must be carried, in metres.
        left_s: Estimated time.
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


@dataclass(frozen=True)
class CampaignTrial:
    """A campaign starts a trial.

    Attributes:
        trial: Name of the trial.
        number: Its number among the trials that are run, from 1.
        total: Number of all trials.
    """

    trial: str
    number: int
    total: int


@dataclass(frozen=True)
class CampaignWent:
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


@dataclass(frozen=True)
class CampaignEnded:
    """The campaign is finished or was stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished trials.
        total: Number of all trials.
    """

    folder: str
    done: int
    total: int
