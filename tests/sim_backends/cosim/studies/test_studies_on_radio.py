"""Studies of a network with contention, fading and rate control: exact policies agree, forks are independent."""

import pytest

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.comparison import Spread, compare_runs, lost_share
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.sync_policy import PolicyError, SyncPolicy
from sim_backends.cosim.policies.window_policies import EventDriven, Scheduled, VariableStepped, VelocityAwareRaw
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.studies.local_errors import local_errors
from sim_backends.network.radio import RadioNetwork
from sim_backends.physics.paths import Paths
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import WayPoints

MS = 1_000_000
PERIODS_NS = {("a", "b"): 3_700_001, ("b", "c"): 5_100_003, ("c", "a"): 4_300_007}


def three_robots(policy: SyncPolicy) -> Coordinator:
    """Return three robots that pass each other at distances at which many packets are lost."""
    motions = {
        "a": WayPoints("a", [(0.0, 0.0, 1.0), (0.0, 200.0, 1.0)], 1.0),
        "b": WayPoints("b", [(120.0, 0.0, 1.0), (0.0, 30.0, 1.0)], 5.0),
        "c": WayPoints("c", [(60.0, 90.0, 1.0), (10.0, 20.0, 1.0)], 2.0),
    }
    antennas = dict.fromkeys(motions, Antenna("802.11g", 15.0, -90.0))
    network = RadioNetwork(WifiInWorld(3, RadioOptions(), antennas, None), list(motions))
    programs = {
        source: Periodic(f"{source} to {destination}", destination, period_ns=period_ns, size_bytes=400)
        for (source, destination), period_ns in PERIODS_NS.items()
    }
    return Coordinator(Agents(Paths(list(motions.values())), programs), network, policy, list(PERIODS_NS))


def test_exact_policies_agree_on_the_radio_and_a_fixed_window_does_not() -> None:
    reference = three_robots(EventDriven()).advance(600 * MS)
    assert lost_share(reference) > 0.03, "losses that could differ"
    errors_of_variable_steps = compare_runs(reference, three_robots(VariableStepped()).advance(600 * MS))
    assert errors_of_variable_steps.packets == len(reference.fates) - sum(
        not fate.is_decided for fate in reference.fates.values()
    )
    assert errors_of_variable_steps.delivery_error_s == errors_of_variable_steps.late_s == Spread(0, 0, 0)
    assert errors_of_variable_steps.position_error_m == compare_runs(reference, reference).position_error_m, (
        "states are held for equal steps"
    )
    assert (errors_of_variable_steps.fate_disagreement, errors_of_variable_steps.causality_violations) == (0, 0)
    errors_of_fixed_window = compare_runs(reference, three_robots(Scheduled(0.02)).advance(600 * MS))
    assert errors_of_fixed_window.delivery_error_s.mean > 0.005
    assert errors_of_fixed_window.fate_disagreement > 0


def test_the_papers_rule_reports_the_pair_for_which_time_runs_backwards() -> None:
    with pytest.raises(PolicyError, match=r"a publishes at 1 m/s to b at 5 m/s.*runs backwards"):
        three_robots(VelocityAwareRaw(0.001)).advance(MS)


def test_local_errors_can_be_measured_from_any_state_of_the_radio() -> None:
    errors_by_policy = local_errors(
        three_robots,
        {"scheduled": Scheduled, "exact": lambda _: VariableStepped()},
        (0.02, 0.04),
        [50 * MS, 100 * MS],
        tail_ns=60 * MS,
    )
    assert not any(errors_by_policy["exact"].sums[measure].any() for measure in errors_by_policy["exact"].sums)
    assert errors_by_policy["scheduled"].mean("delivery_s") == pytest.approx([0.01, 0.02], rel=0.4)
