"""`sliding_window` (SynchroSim, ROS-NetSim): the network follows the physics by one window.

The physics advances first. The network then replays the packets that were sent in the window, each at its own time,
with the states at the window's end. An arrival keeps its time, which its receiver has passed by up to a window.
"""

from sim_backends.cosim.policies.fixed import FixedWindow


class SlidingWindow(FixedWindow):
    """The network follows the physics by one window."""

    name = "sliding_window"
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False
