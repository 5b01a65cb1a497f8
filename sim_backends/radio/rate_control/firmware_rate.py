"""Rate control by the firmware of a radio. Real algorithms are not published and differ between versions.

Most robots have such a radio: brcmfmac (FullMAC, Raspberry Pi) and ath10k select rates in firmware, iwlwifi in its
firmware or its driver. The model contains the common features of these algorithms, with two parameters: margin and
interval. The firmware measures the signal of the peer's frames. After each interval it selects the fastest mode that
has at most 10 % of errors at a signal that is weaker by the margin. If fewer than half of an interval's frames were
acknowledged, it selects a mode one step slower; if more than 90 % were acknowledged, it undoes one such step. Each
further attempt for a frame is one step slower than the attempt before.

To find bounds of a result, compare a margin of 0 dB and a short interval with 10 dB and a long interval.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Final

from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.modes import WifiMode
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.rate_control.rate_control import RateControl

# A mode is usable if at most this share of frames of this size is corrupted.
_REFERENCE_BYTES: Final = 1200
_TARGET_ERROR: Final = 0.1
# Shares of acknowledged frames below and above which the mode changes by one step.
_STEP_DOWN_BELOW, _STEP_UP_ABOVE = 0.5, 0.9
# Range and precision of the search for the ratio of signal to noise that a mode requires.
_LOWEST_DB, _HIGHEST_DB, _PRECISION_DB = -10.0, 60.0, 0.01


class FirmwareRate(RateControl):
    """Rate control of one link.

    Args:
        modes: The available modes.
        signal_to_noise_db: Returns the ratio of the peer's signal to the noise in 20 MHz at a time in ns.
        margin_db: Margin below the measured signal.
        interval_ns: Time between two selections.
    """

    def __init__(
        self,
        modes: Sequence[WifiMode],
        signal_to_noise_db: Callable[[int], float],
        *,
        margin_db: float,
        interval_ns: int,
    ) -> None:
        self._modes = useful_modes(modes)
        self._required_db = [required_db(mode) for mode in self._modes]
        self._signal_to_noise_db = signal_to_noise_db
        self._margin_db = margin_db
        self._interval_ns = interval_ns
        self._next_ns = 0
        self._mode_index = self._steps_down = 0
        self._frames = self._acknowledged = 0

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:  # noqa: ARG002 (see RateControl)
        """Implement `RateControl.choose`."""
        if attempt == 1 and now_ns >= self._next_ns:
            self._select(now_ns)
        return self._modes[max(self._mode_index - self._steps_down - (attempt - 1), 0)]

    def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:  # noqa: ARG002 (see RateControl)
        """Implement `RateControl.report`."""
        self._frames += frames
        self._acknowledged += acknowledged

    def _select(self, now_ns: int) -> None:
        self._next_ns = now_ns + self._interval_ns
        usable_db = self._signal_to_noise_db(now_ns) - self._margin_db
        self._mode_index = max(sum(mode_db <= usable_db for mode_db in self._required_db) - 1, 0)
        if self._frames:
            share = self._acknowledged / self._frames
            self._frames = self._acknowledged = 0
            if share < _STEP_DOWN_BELOW:
                self._steps_down += 1
            elif share > _STEP_UP_ABOVE:
                self._steps_down -= 1
        self._steps_down = min(max(self._steps_down, 0), self._mode_index)


def useful_modes(modes: Sequence[WifiMode]) -> tuple[WifiMode, ...]:
    """Return the modes that no other mode matches or exceeds in both rate and robustness, slowest first."""
    useful: list[WifiMode] = []
    for mode in sorted(modes, key=lambda mode: (required_db(mode), -mode.rate_bit_s)):
        if not useful or mode.rate_bit_s > useful[-1].rate_bit_s:
            useful.append(mode)
    return tuple(useful)


@cache
def required_db(mode: WifiMode) -> float:
    """Return the ratio of signal to noise in 20 MHz at which 10 % of frames of 1200 bytes are corrupted."""
    low_db, high_db = _LOWEST_DB, _HIGHEST_DB
    while high_db - low_db > _PRECISION_DB:
        middle_db = (low_db + high_db) / 2
        if packet_error(mode, middle_db - decibel(mode.noise_factor), _REFERENCE_BYTES) > _TARGET_ERROR:
            low_db = middle_db
        else:
            high_db = middle_db
    return high_db
