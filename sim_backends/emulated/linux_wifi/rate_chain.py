"""Rate chains of mac80211: the mode of each try of a frame, and the number of tries in each stage.

The radio model has the modes of 802.11g (6 to 54 Mbit/s), and MCS 0 to 7 of 802.11n with one stream, in 20 MHz with
the long guard interval. Stages in other modes are mapped or skipped:

- DSSS and CCK (802.11b) have the airtime and the robustness of 6 Mbit/s.
- A short guard interval counts as a long one.
- MCS 0 to 7 of 802.11ac with one stream in 20 MHz count as those of 802.11n.
- Two or more streams, 40 MHz and wider, and modes of 802.11ac above MCS 7 are skipped: they are reported as failed
  tries without airtime, so minstrel_ht avoids them, as on a radio with one antenna.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.emulated.linux_wifi.hwsim_messages import (
    RATE_40_MHZ,
    RATE_80_MHZ,
    RATE_160_MHZ,
    RATE_MCS,
    RATE_VHT,
    RateStage,
)
from sim_backends.radio.phy.modes import G_MODES, N_MODES, SHORT_RETRY_LIMIT, WifiMode

_DSSS_RATES: Final = 4
"""Number of DSSS and CCK rates (1, 2, 5.5 and 11 Mbit/s) at the beginning of the list of the 2.4 GHz band."""
_BAND_LIMIT_MHZ: Final = 3_000
"""Frequencies below this are in the 2.4 GHz band; the others are in bands whose rate lists have no DSSS and CCK."""
_WIDE: Final = RATE_40_MHZ | RATE_80_MHZ | RATE_160_MHZ


@dataclass(frozen=True)
class RateChain:
    """The tries of a frame.

    Attributes:
        modes: Mode of each try on the air; empty if all stages are skipped.
        stages: For each try on the air, the index of its stage in the chain.
        is_skipped: For each stage, True if its mode is not in the radio model.
        stage_tries: For each stage, the number of tries that mac80211 requested, at least 1.
    """

    modes: tuple[WifiMode, ...]
    stages: tuple[int, ...]
    is_skipped: tuple[bool, ...]
    stage_tries: tuple[int, ...]

    def tries_made(self, attempts: int) -> list[int]:
        """Return the number of tries in each stage, up to the stage of the last attempt on the air.

        Skipped stages count with all their tries. With 0 attempts the list has all stages of the chain; this is the
        result for a chain whose stages are all skipped.

        Args:
            attempts: Number of attempts on the air, at most the length of `modes`.
        """
        last_stage = self.stages[attempts - 1] if attempts else len(self.is_skipped) - 1
        on_air = Counter(self.stages[:attempts])
        return [
            self.stage_tries[stage] if self.is_skipped[stage] else on_air[stage] for stage in range(last_stage + 1)
        ]


def rate_chain(stages: Sequence[RateStage], frequency_mhz: int, *, max_tries: int = SHORT_RETRY_LIMIT) -> RateChain:
    """Return the tries of a chain of stages.

    Args:
        stages: The stages; without stages the chain has one try at 6 Mbit/s.
        frequency_mhz: Frequency of the channel.
        max_tries: Maximum number of tries on the air; later tries are omitted.
    """
    used_stages = list(stages) or [RateStage(0, 1)]
    modes: list[WifiMode] = []
    numbers: list[int] = []
    is_skipped = []
    for number, stage in enumerate(used_stages):
        mode = mode_of(stage, frequency_mhz)
        is_skipped.append(mode is None)
        if mode is not None:
            tries = min(max(stage.tries, 1), max_tries - len(modes))
            modes += [mode] * tries
            numbers += [number] * tries
    stage_tries = tuple(max(stage.tries, 1) for stage in used_stages)
    return RateChain(tuple(modes), tuple(numbers), tuple(is_skipped), stage_tries)


def mode_of(stage: RateStage, frequency_mhz: int) -> WifiMode | None:
    """Return the mode of a stage in the radio model, or None if the model does not have it."""
    if stage.flags & _WIDE:
        return None
    if stage.flags & (RATE_MCS | RATE_VHT):
        # In VHT, the index has the MCS in its four lower bits, and the number of streams minus one in the bits above.
        # In HT, MCS 8 and above have two or more streams. So all supported modes have an index below 8.
        return N_MODES[stage.index] if 0 <= stage.index < len(N_MODES) else None
    index = stage.index if frequency_mhz >= _BAND_LIMIT_MHZ else stage.index - _DSSS_RATES
    if index < 0:
        return G_MODES[0]
    return G_MODES[index] if index < len(G_MODES) else None


def legacy_index(mode: WifiMode, frequency_mhz: int) -> int:
    """Return the index of a mode in the list of the band's legacy rates (those without an MCS).

    For an MCS this is the index of the rate with the same modulation and code rate, or of the fastest rate if no rate
    has them.
    """
    coding = (mode.modulation, mode.code_rate)
    indices = [index for index, g_mode in enumerate(G_MODES) if (g_mode.modulation, g_mode.code_rate) == coding]
    index = indices[0] if indices else len(G_MODES) - 1
    return index if frequency_mhz >= _BAND_LIMIT_MHZ else index + _DSSS_RATES
