"""`variable_stepped` (CORNET): one scheduler merges the physics' steps and the network's events by time."""

from sim_backends.cosim.policies.base import Situation


class VariableStepped:
    """A window lasts until the next step of the physics or the next event, whichever is first."""

    name = "variable_stepped"
    exact = True
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def next_window(self, situation: Situation) -> int:
        """Return the time of the next step or event."""
        step_ns = situation.physics_step_ns
        next_step_ns = (situation.now_ns // step_ns + 1) * step_ns
        next_ns = situation.next_ns
        return next_step_ns if next_ns is None else min(next_step_ns, next_ns)
