"""`event_driven` (CPS-Sim): the physics is made to stand at the exact time of every event of the network."""

from sim_backends.cosim.policies.base import Situation


class EventDriven:
    """A window lasts until the next event, of a program or in the network. This is the exact reference."""

    name = "event_driven"
    exact = True
    holds_sends = False
    knows_end = True
    holds_arrivals = False

    def next_window(self, situation: Situation) -> int | None:
        """See `SyncPolicy.next_window`."""
        return situation.next_ns
