"""`event_driven` (CPS-Sim): the physics stops at the exact time of every network event."""

from sim_backends.cosim.policies.base import Situation


class EventDriven:
    """A window lasts until the next event, of a program or in the network. This is the exact reference."""

    name = "event_driven"
    exact = True
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def next_window(self, situation: Situation) -> int | None:
        """Return the time of the next event, or None if there are no more events."""
        return situation.next_ns
