"""Lets physics and programs go ahead of the network in a window, as far as a policy that looks ahead allows."""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

from sim_backends.cosim.agents import Agents, Sent
from sim_backends.cosim.policies.base import Situation
from sim_backends.cosim.watchdog import DeadlinePassed, failed, seconds
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State


class Ahead(NamedTuple):
    """How far physics and programs went.

    Attributes:
        end_ns: To the end of the window.
        sent: What programs sent.
        states: Where the agents are then.
        looked_s: Wall time that the policy took.
    """

    end_ns: int
    sent: list[Sent]
    states: Mapping[str, State]
    looked_s: float


def known_later(situation: Situation, *, moves: bool) -> DeadReckoned:
    """Return where a network takes the agents to be in a window that begins now.

    Args:
        situation: Now.
        moves: Whether it lets them move on; else they stand for it.
    """
    states = situation.states
    if not moves:
        states = {name: State(state.position_m) for name, state in states.items()}
    return DeadReckoned(states, situation.now_ns, situation.physics_step_ns)


def go_ahead(
    agents: Agents,
    goes_on: Callable[[Situation], int],
    situation: Situation,
    known: DeadReckoned,
    *,
    end_ns: int,
    most_ns: int,
) -> Ahead:
    """Let physics and programs go on to the end of a window.

    Args:
        agents: Both.
        goes_on: The policy's, see `LookingAhead`.
        situation: At the window's begin.
        known: Where the network takes the agents to be in it.
        end_ns: Until when the policy let them go on at first.
        most_ns: Where the window ends in any case.

    Raises:
        FederateError: Physics, a program or the policy failed, or did not answer in time.
    """
    sent = agents.advance(situation.now_ns, end_ns - 1)
    states = agents.states(end_ns)
    looked_s = 0.0
    while end_ns < most_ns:
        begun_s = time.perf_counter()
        now = situation._replace(
            now_ns=end_ns,
            states=states,
            next_wake_ns=agents.next_wake_ns(),
            next_send_ns=end_ns if sent else agents.next_send_ns(),
            known=known.at(end_ns),
        )
        try:
            later_ns = min(goes_on(now), most_ns)
        except (Exception, DeadlinePassed) as error:
            asked = f"say until when the window goes on that has come to {seconds(end_ns)}"
            raise failed(error, "the policy", asked) from error
        looked_s += time.perf_counter() - begun_s
        if later_ns <= end_ns:
            break
        sent += agents.advance(end_ns, later_ns - 1)
        states, end_ns = agents.states(later_ns), later_ns
    return Ahead(end_ns, sent, states, looked_s)
