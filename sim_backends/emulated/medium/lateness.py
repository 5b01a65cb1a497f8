"""How the medium counts lateness: few enough values to keep, near enough to the true ones."""

from typing import Final

_KEPT_BITS: Final = 4


def rounded_up(late_ns: int) -> int:
    """Return the least number above `late_ns` of which all but the first four bits are 0: at most 1/8 more."""
    shift = late_ns.bit_length() - _KEPT_BITS
    return late_ns + 1 if shift <= 0 else ((late_ns >> shift) + 1) << shift
