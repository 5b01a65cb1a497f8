"""`time_stepped` (PiccSim, RoboNetSim): both simulators stop at fixed thresholds, and exchange data only there.

Both simulate a window in parallel. Packets sent in it enter the network at its end, arrivals in it count from its
end, and the network uses the states at its beginning.
"""

from sim_backends.cosim.policies.fixed import FixedWindow


class TimeStepped(FixedWindow):
    """Data is exchanged at thresholds only."""

    name = "time_stepped"
    defers_sends = True
    uses_end_states = False
    defers_arrivals = True
