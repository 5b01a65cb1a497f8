"""Columns of the frames that a radio sent and received, from a capture on its monitor interface."""

from typing import Final

import numpy as np

from fieldkit.core.columns import BACKGROUND, PHY_RATE, Column, Figure, Kind, Measured, Value, columns
from fieldkit.core.model import Role
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.captures.radiotap import NO_SIGNAL, RadioFrames

ROLES: Final = (Role.SENDER, Role.RECEIVER)
"""Roles whose monitor interfaces have columns."""

_NO_FRAMES: Final = "the monitor interface has no such frame, or its radiotap headers do not contain the value"


def _role_columns(role: Role) -> tuple[Column, ...]:
    return columns(
        152,
        (
            f"{role}_monitor_sent",
            "count",
            f"Data frames for a single receiver that the {role}'s radio sent, on its monitor interface.",
        ),
        (
            f"{role}_monitor_retries",
            "count",
            f"Retransmissions of the frames in {role}_monitor_sent (radiotap: data retries).",
            Figure(f"retransmitted frames, {role}", Kind.MEDIAN, rank=BACKGROUND + 2),
        ),
        (
            f"{role}_monitor_failures",
            "count",
            f"Frames in {role}_monitor_sent without an acknowledgement (radiotap: TX flags).",
        ),
        (
            f"{role}_monitor_received",
            "count",
            f"Data frames for the {role}'s radio that it received, on its monitor interface.",
        ),
        (
            f"{role}_monitor_retry_flags",
            "count",
            f"Frames in {role}_monitor_received with the retry flag: an earlier attempt, or its ACK, was lost.",
        ),
        (
            f"{role}_monitor_signal_dbm",
            "dBm",
            f"Median signal of the frames in {role}_monitor_received (radiotap: antenna signal).",
            (-300.0, 100.0),
        ),
        (
            f"{role}_monitor_tx_{PHY_RATE}",
            "bit/s",
            (
                f"Median PHY rate of the first attempts of the frames in {role}_monitor_sent (radiotap: rate, MCS or "
                "VHT); empty for 802.11ax."
            ),
            Figure(f"PHY rate of frames, {role}", Kind.MEDIAN, rank=BACKGROUND + 1),
        ),
        (
            f"{role}_monitor_rx_{PHY_RATE}",
            "bit/s",
            f"Median PHY rate of the frames in {role}_monitor_received; empty for 802.11ax.",
        ),
    )


COLUMNS_BY_ROLE: Final = {role: _role_columns(role) for role in ROLES}
"""Columns of each role."""

COLUMNS: Final = tuple(column for role_columns in COLUMNS_BY_ROLE.values() for column in role_columns)


def measure(role: Role, frames: RadioFrames) -> Measured:
    """Return the columns of a role.

    Args:
        role: One of `ROLES`.
        frames: Frames in the capture on its monitor interface.
    """
    data = frames.where(frames.is_data & frames.is_unicast)
    sent = data.where(data.is_sent)
    received = data.where(~data.is_sent & np.isin(data.receiver, own_addresses(frames)))
    values: dict[str, Value | None] = {
        "sent": len(sent),
        "retries": int(np.maximum(sent.retries, 0).sum()),
        "failures": int(sent.is_failed.sum()),
        "received": len(received),
        "retry_flags": int(received.is_retry.sum()),
        "signal_dbm": _median(received.signal_dbm, NO_SIGNAL),
        f"tx_{PHY_RATE}": _median(sent.rate_bit_s, 0),
        f"rx_{PHY_RATE}": _median(received.rate_bit_s, 0),
    }
    return Measured.from_optional({f"{role}_monitor_{name}": value for name, value in values.items()}, _NO_FRAMES)


def own_addresses(frames: RadioFrames) -> Ints:
    """Return the addresses from which a radio has sent frames."""
    return np.unique(frames.transmitter[frames.is_sent & (frames.transmitter >= 0)])


def _median(values: Ints, missing: int) -> float | None:
    present = values[values != missing]
    return float(np.median(present)) if len(present) else None
