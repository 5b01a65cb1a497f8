"""Which is which among things that look alike, of which some were lost or came several times: told by time."""

import numpy as np

from fieldkit.measure.arrays import Ints, Mask


def places(group: Ints, time_ns: Ints, came_group: Ints, came_time_ns: Ints) -> Ints:
    """Return, per thing received, which of those alike it is a copy of: 0 for the first that was sent, and so on.

    In each group each is taken for the nearest in time, as far as order allows and as all of the fewer side, sent or
    received, find one.

    Args:
        group: Group of those alike, of each thing sent, in ascending order.
        time_ns: When it was sent, in ascending order within its group.
        came_group: Group of each thing received, likewise.
        came_time_ns: When it was received, likewise.
    """
    sent, received = (np.bincount(these, minlength=len(group)) for these in (group, came_group))
    place = np.zeros(len(came_group), dtype=np.int64)
    many = sent > 1
    chosen, left = many[came_group], many[group]
    if not chosen.any():
        return place
    even = sent == received
    offset_ns = _clock_offset_ns(time_ns, even[group], came_time_ns, even[came_group])
    group, time_ns = group[left], time_ns[left]
    came_group, came_time_ns = came_group[chosen], came_time_ns[chosen] - offset_ns
    sent, received = sent * many, received * many
    rank = np.arange(len(came_group)) - (np.cumsum(received) - received)[came_group]
    spare = (sent - received)[came_group]
    skipped = _nearest(group, time_ns, came_group, came_time_ns) - rank
    # Where fewer came, some of those sent are skipped; where more came, some of those sent have several copies.
    sign = np.where(spare < 0, -1, 1)
    skipped = np.clip(sign * skipped, 0, np.abs(spare))
    apart = came_group * (len(group) + len(came_group))
    place[chosen] = rank + sign * (np.maximum.accumulate(skipped + apart) - apart)
    return place


def _nearest(group: Ints, time_ns: Ints, came_group: Ints, came_time_ns: Ints) -> Ints:
    """Return, per thing received, the place of the one sent in its group that is nearest in time."""
    sent = np.bincount(group)
    order = np.lexsort((np.concatenate((time_ns, came_time_ns)), np.concatenate((group, came_group))))
    is_sent = order < len(group)
    first, last = (np.cumsum(sent) - sent)[came_group], np.cumsum(sent)[came_group] - 1
    after = np.cumsum(is_sent)[~is_sent]
    earlier, later = np.maximum(after - 1, first), np.minimum(after, last)
    nearest: Ints = np.where(came_time_ns - time_ns[earlier] < time_ns[later] - came_time_ns, earlier, later) - first
    return nearest


def _clock_offset_ns(sent_ns: Ints, sent_even: Mask, received_ns: Ints, received_even: Mask) -> int:
    """Return the receiver's clock minus the sender's, delay included, from the groups of which all arrived."""
    if not sent_even.any():
        return int(received_ns.min() - sent_ns.min())
    return int(np.median(received_ns[received_even] - sent_ns[sent_even]))
