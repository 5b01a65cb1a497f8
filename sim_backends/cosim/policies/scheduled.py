"""`scheduled` (FlyNetSim): one common sampling period; output of the faster simulator waits for the next sample.

The network simulator is the faster one. Packets enter it when they are sent, with the states of the last sample; its
deliveries wait in a buffer for the next sample.
"""

from sim_backends.cosim.policies.fixed import FixedWindow


class Scheduled(FixedWindow):
    """Packets enter the network immediately, and leave it at samples."""

    name = "scheduled"
    defers_sends = False
    uses_end_states = False
    defers_arrivals = True
