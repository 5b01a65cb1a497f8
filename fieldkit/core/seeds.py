"""Seeds of testbeds that are opened several times for one trial or campaign."""

from typing import Final

_SEEDS: Final = 10**15
"""Number of seeds that a person can choose: a seed has at most 15 digits."""

_OPENINGS: Final = 18_000
"""Number of attempts after which the seeds of testbeds repeat.

The largest seed, 18,000 * 10^15, is below 2^64, because federates receive the seed as an unsigned 64-bit integer.
"""


def testbed_seed(seed: int, attempts: int) -> int:
    """Return the seed of a testbed that is opened after a number of attempts.

    A testbed that is opened again with the same seed draws the same random numbers again. The repeats of a resumed
    trial would then have the same losses as its first repeats.

    Args:
        seed: Seed of the trial or campaign.
        attempts: Number of attempts that have started before.
    """
    return seed + attempts % _OPENINGS * _SEEDS


def place_seed(seed: int) -> int:
    """Return the seed of properties of a place, for example shadowing, which are the same in a resumed trial."""
    return seed % _SEEDS
