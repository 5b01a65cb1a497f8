"""`time_stepped` (PiccSim, RoboNetSim): both simulators halt at fixed thresholds, and share data only there.

Both go through a window side by side. What is sent in it enters the network at its end, what arrives in it counts
from there, and the network knows where the agents were at its beginning.
"""

from sim_backends.cosim.policies.fixed import FixedWindow


class TimeStepped(FixedWindow):
    """Data is shared at thresholds only."""

    name = "time_stepped"
    holds_sends = True
    knows_end = False
    holds_arrivals = True
