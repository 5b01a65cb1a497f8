"""`scheduled` (FlyNetSim): one common sampling period; what the faster simulator produced waits for the next sample.

The network simulator is the faster one. It gets packets as they are sent, with the states of the last sample; what it
delivers waits in a buffer for the next.
"""

from sim_backends.cosim.policies.fixed import FixedWindow


class Scheduled(FixedWindow):
    """Packets go into the network at once, and out of it at samples."""

    name = "scheduled"
    holds_sends = False
    knows_end = False
    holds_arrivals = True
