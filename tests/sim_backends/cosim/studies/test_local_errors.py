"""Local errors compared with results computed by hand: a moving pair, a hard range limit, a constant delay."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from fieldkit.core.errors import FieldkitError
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Action, PhysicsFederate, Program
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.policies.window_policies import (
    EventDriven,
    Scheduled,
    SlidingWindow,
    TimeStepped,
    VariableStepped,
    VelocityAware,
    VelocityAwareRaw,
)
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.studies.formation import SampledPhysics, Tracks
from sim_backends.cosim.studies.local_errors import MEASURES, local_errors, low_discrepancy_times_ns, pool
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Drop, Packet, ReceivedDatagram
from sim_backends.world.motion import State
from tests.helpers.moving_pair import DELAY_NS, LEAVES_NS, PERIOD_NS, SPEED_M_S, STEP_NS, moving_pair

MS = 1_000_000
DELAY_S = DELAY_NS / 1e9
WINDOWS_S = (0.02, 0.06, 0.2)
STARTS_IN_RANGE_NS = low_discrepancy_times_ns(4_000 * MS, 7_500 * MS, 30, STEP_NS)
"""Starts of windows during which the pair is always within range."""


def mean_wait_s(window_s: float) -> float:
    """Return the mean time that packets which arrive in a window wait for its end, over all affected packets."""
    return window_s**2 / 2 / (window_s + DELAY_S)


def mean_wait_at_both_ends_s(window_s: float) -> float:
    """Return the mean wait if packets also wait for the end of the window in which they are sent."""
    return (window_s**2 / 2 + DELAY_S * (window_s - DELAY_S / 2)) / (window_s + DELAY_S)


def path_error_m(window_s: float) -> float:
    return SPEED_M_S * window_s / 2


STEP_MOTION_M = SPEED_M_S * STEP_NS / 1e9
"""Motion during a step of the physics; states do not change within a step."""


Law = Callable[[float], float]
LAWS: dict[str, tuple[Callable[[float], SyncPolicy], dict[str, Law]]] = {
    "time_stepped": (TimeStepped, {"delivery_s": mean_wait_at_both_ends_s, "position_m": path_error_m}),
    "scheduled": (Scheduled, {"delivery_s": mean_wait_s, "position_m": path_error_m}),
    "sliding_window": (SlidingWindow, {"late_s": mean_wait_s, "position_m": path_error_m}),
    "velocity_aware_raw": (VelocityAwareRaw, {"late_s": mean_wait_s, "position_m": path_error_m}),
    "velocity_aware": (
        lambda window_s: VelocityAware(window_s, 1.0),
        {"late_s": mean_wait_s, "position_m": path_error_m},
    ),
    # Both velocities are constant, so the extrapolation is exact, and windows have their maximum length.
    "error_bounded": (lambda window_s: ErrorBounded(1e-9, window_s), {"delivery_s": mean_wait_s}),
    "variable_stepped": (lambda _: VariableStepped(), {}),
    "event_driven": (lambda _: EventDriven(), {}),
}


def test_each_method_has_the_errors_and_the_order_computed_by_hand() -> None:
    errors_by_policy = local_errors(
        moving_pair, {name: kind for name, (kind, _) in LAWS.items()}, WINDOWS_S, STARTS_IN_RANGE_NS, tail_ns=20 * MS
    )
    for name, (_, laws) in LAWS.items():
        errors = errors_by_policy[name]
        lengths_s = errors.window_s.mean(axis=1)
        for measure in MEASURES:
            if measure not in laws:
                limit = STEP_MOTION_M * errors.counts[measure] if measure == "position_m" else 1e-9
                assert (errors.sums[measure] <= limit).all(), f"{name} has no error in {measure}"
                continue
            expected = [laws[measure](length_s) for length_s in lengths_s]
            assert errors.mean(measure) == pytest.approx(expected, rel=0.05), f"{name} {measure}"
            order = errors.order(measure)
            assert order.value == pytest.approx(1.0, abs=0.05), f"{name} {measure}"
            assert order.low < order.value < order.high < order.low + 0.1, "a narrow interval"
    assert errors_by_policy["velocity_aware_raw"].window_s[0] == pytest.approx(0.02 + SPEED_M_S / 1000)


def test_the_share_of_packets_with_another_fate_at_the_range_limit_is_proportional_to_the_window() -> None:
    """The states are those at the beginning or the end of a window, so on average half of its packets are wrong."""
    windows_s = (0.04, 0.08, 0.16)
    begins_ns = range(LEAVES_NS // MS * MS - 170 * MS, LEAVES_NS, 2 * MS)
    methods: dict[str, Callable[[float], SyncPolicy]] = {"scheduled": Scheduled, "sliding_window": SlidingWindow}
    for name, errors in local_errors(moving_pair, methods, windows_s, begins_ns, tail_ns=5 * MS).items():
        # A share of w / 170 ms of the windows contains the range limit, and half of the packets sent in them are
        # wrong; packets that were sent before and arrive in them are not.
        expected = [window_s / 0.17 / 2 * window_s / (window_s + DELAY_S) for window_s in windows_s]
        assert errors.mean("fates") == pytest.approx(expected, rel=0.12), name
        assert errors.order("fates").value == pytest.approx(1.0, abs=0.1), name


class CommandedMotion:
    """A stationary body, and one that moves at the last commanded velocity, in steps of 10 us."""

    step_ns = STEP_NS

    def __init__(self) -> None:
        self.limits_m_s2: Mapping[str, float] = {"lead": 0.0, "chaser": math.inf}
        self._at_ns, self._place_m, self._speed_m_s = 0, 0.0, 0.0

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        self._speed_m_s = commands.get("chaser", self._speed_m_s)
        at_ns = to_ns // self.step_ns * self.step_ns
        self._place_m += self._speed_m_s * (at_ns - self._at_ns) / 1e9
        self._at_ns = at_ns
        return {
            "lead": State((0.0, 0.0, 0.0)),
            "chaser": State((self._place_m, 0.0, 0.0), (self._speed_m_s, 0.0, 0.0)),
        }


class AcceleratingProgram:
    """Increases its speed by 1 mm/s for every received datagram."""

    def __init__(self) -> None:
        self._speed_m_s = 0.0

    def next_wake_ns(self) -> None:
        return None

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self._speed_m_s += 0.001 * len(received)
        return Action(command=self._speed_m_s)


def chase(policy: SyncPolicy, physics: PhysicsFederate | None = None) -> Coordinator:
    programs: dict[str, Program] = {
        "lead": Periodic("lead", "chaser", period_ns=500_000),
        "chaser": AcceleratingProgram(),
    }
    return Coordinator(
        Agents(physics or CommandedMotion(), programs), Disc(100.0, 100_000), policy, [("lead", "chaser")]
    )


def test_the_position_error_of_one_window_in_a_closed_loop_is_of_the_second_order() -> None:
    """The chaser accelerates by 2 m/s^2; without datagrams in a window w, its path is shorter by 2 m/s^2 w^2 / 2."""
    begins_ns = low_discrepancy_times_ns(100 * MS, 900 * MS, 6, STEP_NS)
    errors = local_errors(chase, {"scheduled": Scheduled}, WINDOWS_S, begins_ns, tail_ns=5 * MS)["scheduled"]
    # The mean over two agents, one of which does not move.
    assert errors.mean("path_m") == pytest.approx(np.square(WINDOWS_S) / 2, rel=0.05)
    assert errors.order("path_m").value == pytest.approx(2.0, abs=0.03)


def test_the_position_error_of_a_whole_run_grows_and_is_of_the_first_order() -> None:
    """With a mean lag of w / 2, the speed is too low by 2 m/s^2 w / 2, so the position error grows with time."""

    def tracks(policy: SyncPolicy) -> Tracks:
        sampled_physics = SampledPhysics(CommandedMotion(), 50 * MS)
        chase(policy, sampled_physics).advance(1000 * MS)
        return sampled_physics.tracks

    exact = tracks(EventDriven())
    assert exact.names == ("lead", "chaser")
    assert exact.times_s == pytest.approx(np.arange(21) * 0.05)
    errors_of_long_windows_m, errors_of_short_windows_m = (
        tracks(Scheduled(window_s)).distances_m(exact)[:, 1] for window_s in (0.1, 0.05)
    )
    assert errors_of_short_windows_m == pytest.approx(exact.times_s * 0.05, abs=0.05**2)
    assert errors_of_long_windows_m[-1] / errors_of_short_windows_m[-1] == pytest.approx(2.0, rel=0.03)


def test_windows_of_several_runs_are_pooled() -> None:
    first, second = (
        local_errors(moving_pair, {"scheduled": Scheduled}, (0.05, 0.1), begins_ns, tail_ns=20 * MS)["scheduled"]
        for begins_ns in (STARTS_IN_RANGE_NS[:5], STARTS_IN_RANGE_NS[5:12])
    )
    pooled_errors = pool([first, second])
    assert pooled_errors.window_s.shape == (2, 12)
    total = first.sums["delivery_s"].sum(axis=1) + second.sums["delivery_s"].sum(axis=1)
    assert pooled_errors.sums["delivery_s"].sum(axis=1) == pytest.approx(total)


SHARED: list[int] = []


class SharedDelayNetwork(Disc):
    """A network whose delay depends on data that all copies share."""

    def __init__(self) -> None:
        super().__init__(100.0, DELAY_NS)
        SHARED.clear()

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        SHARED.extend(packet.packet_id for packet in packets)
        self._delay_ns = DELAY_NS + len(SHARED)
        return super().advance(to_ns, packets, states)


def test_data_that_is_not_copied_is_detected() -> None:
    def make(policy: SyncPolicy) -> Coordinator:
        agents = Agents(CommandedMotion(), {"lead": Periodic("lead", "chaser", period_ns=MS)})
        return Coordinator(agents, SharedDelayNetwork(), policy, [("lead", "chaser")])

    with pytest.raises(FieldkitError, match="a fork changed the run"):
        local_errors(make, {"scheduled": Scheduled}, (0.01,), [10 * MS, 20 * MS], tail_ns=5 * MS)


def test_beginnings_are_distributed_over_all_phases_of_a_period() -> None:
    times_ns = low_discrepancy_times_ns(0, 10**9, 1000, 1)
    assert times_ns == sorted(times_ns)
    phases = np.sort([at_ns % PERIOD_NS / PERIOD_NS for at_ns in times_ns])
    # As even as random phases: Kolmogorov's bound for 1000 values at a probability of one in a million.
    assert abs(phases - (np.arange(1000) + 0.5) / 1000).max() < 2.7 / math.sqrt(1000)
