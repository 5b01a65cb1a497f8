"""Links that do the same wherever robots stand."""

from collections.abc import Iterable
from itertools import permutations

from sim_backends.radio.options import RadioOptions
from sim_backends.radio.parameters import LinkParameters, Pair


def mesh(options: RadioOptions, names: Iterable[str]) -> dict[Pair, LinkParameters]:
    """Return the fixed links between all stations `names`, in both directions."""
    return dict.fromkeys(permutations(names, 2), options.link())
