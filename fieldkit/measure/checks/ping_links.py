"""Requests of a ping that left and arrived over each of several links, in captures on all interfaces."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from fieldkit.core.columns import Column, Figure, Kind, Measured, columns
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.checks.ping_duplicates import PingEchoes, echo_keys, echoes_by_interface

_UNKNOWN_INTERFACE: Final = (
    "the interface of the link {link} is unknown: `ip -o link` failed on a robot, or the interface was replaced"
)
_NO_CHANGE: Final = "no request changed from another link to this one"


class LinkEnds(NamedTuple):
    """Indices of the interfaces of a link.

    Attributes:
        sender: Index of the sender's interface; None if it is unknown.
        receiver: Index of the receiver's interface; None if it is unknown.
    """

    sender: int | None
    receiver: int | None


def declare_columns(link: str) -> tuple[Column, ...]:
    """Return the columns of a link."""
    prefix = _prefix(link)
    return columns(
        110,
        (
            f"{prefix}_sent",
            "count",
            f"Requests of ping that left the sender over the link {link}.",
            Figure(f"requests over {link}", Kind.MEDIAN),
        ),
        (
            f"{prefix}_lost",
            "count",
            f"Requests that left the sender over {link} and arrived at the receiver over no link.",
            Figure(f"lost over {link}", Kind.MEDIAN),
        ),
        (
            f"{prefix}_duplicates",
            "count",
            f"Requests that arrived over {link} after they had arrived over another link.",
        ),
        (
            f"{prefix}_failover_s",
            "s",
            (
                "Longest time from the arrival of a request over another link to the arrival of the next request "
                f"over {link}; its resolution is the interval of ping. Empty if no request changed to {link}."
            ),
            Figure(f"failover to {link}", Kind.MEDIAN),
        ),
    )


def measure(links: Mapping[str, LinkEnds], sender: PingEchoes | None, receiver: PingEchoes | None) -> Measured:
    """Return the columns of each link.

    Args:
        links: The links by name.
        sender: Echoes in the sender's capture; None if it is missing or incomplete.
        receiver: Echoes in the receiver's capture; None if it is missing or incomplete.
    """
    echoes = echoes_by_interface(sender, receiver)
    result = Measured()
    for link, ends in links.items():
        if isinstance(echoes, str):
            result |= Measured.all_missing(declare_columns(link), echoes)
        elif ends.sender is None or ends.receiver is None:
            result |= Measured.all_missing(declare_columns(link), _UNKNOWN_INTERFACE.format(link=link))
        else:
            at_sender, at_receiver = echoes
            result |= _measure_link(link, ends, at_sender.requests, at_receiver.requests)
    return result


def _measure_link(link: str, ends: LinkEnds, sent: Packets, arrived: Packets) -> Measured:
    prefix = _prefix(link)
    sent_keys = np.unique(echo_keys(sent.where(sent.interface == ends.sender)))
    arrived_keys = echo_keys(arrived)
    keys, first_rows = np.unique(arrived_keys, return_index=True)
    is_over_link = arrived.interface == ends.receiver
    # Requests that arrived over this link, but whose first arrival was over another link.
    later_keys = np.setdiff1d(arrived_keys[is_over_link], keys[is_over_link[first_rows]])
    values: dict[str, int | float] = {
        f"{prefix}_sent": len(sent_keys),
        f"{prefix}_lost": len(np.setdiff1d(sent_keys, keys)),
        f"{prefix}_duplicates": len(later_keys),
    }
    missing = {}
    gaps_s = _changes_s(arrived.time_ns[np.sort(first_rows)], is_over_link[np.sort(first_rows)])
    if (arrived.time_ns == NO_TIME).any():
        missing[f"{prefix}_failover_s"] = "packets in the receiver's capture have no time"
    elif gaps_s:
        values[f"{prefix}_failover_s"] = max(gaps_s)
    else:
        missing[f"{prefix}_failover_s"] = _NO_CHANGE
    return Measured(values, missing)


def _changes_s(times_ns: Ints, is_over_link: Mask) -> list[float]:
    """Return the time in seconds that each change to the link took.

    Args:
        times_ns: Time of the first arrival of each request, in the order of the capture.
        is_over_link: True for each request that arrived over the link.
    """
    rows = np.flatnonzero(~is_over_link[:-1] & is_over_link[1:])
    return [int(times_ns[row + 1] - times_ns[row]) / 1e9 for row in rows.tolist()]


def _prefix(link: str) -> str:
    return f"rtt_over_{link.replace('-', '_')}"
