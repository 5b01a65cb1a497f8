"""`sliding_window` (SynchroSim, ROS-NetSim): the events of a window are captured, then the network goes to its end.

The physics goes first. The network then replays what was sent in the window, each packet at its own time, knowing
where the agents are at the window's end. An arrival keeps its time, which its receiver has passed by up to a window.
"""

from sim_backends.cosim.policies.fixed import FixedWindow


class SlidingWindow(FixedWindow):
    """The network follows the physics by one window."""

    name = "sliding_window"
    holds_sends = False
    knows_end = True
    holds_arrivals = False
