import pytest

from fieldkit.core import geometry
from fieldkit.core.model import Distance, Leg, Placement, Post, Role, Scenario, Topology, Vector

RIVAL = Role("rival")


@pytest.mark.parametrize(
    ("topology", "reference", "leg", "position_m"),
    [
        # East is the direction from the sender to the receiver, north is to the left of it.
        (Topology.MASTERLESS, Role.RECEIVER, Leg(away_m=2.0), (12.0, 0.0, 0.0)),
        (Topology.MASTERLESS, Role.RECEIVER, Leg(left_m=3.0), (10.0, 3.0, 0.0)),
        (Topology.MASTERLESS, Role.SENDER, Leg(away_m=2.0), (-2.0, 0.0, 0.0)),
        (Topology.MASTERLESS, Role.SENDER, Leg(left_m=3.0), (0.0, -3.0, 0.0)),
        (Topology.MASTERLESS, Role.SENDER, Leg(away_m=-4.0, left_m=-3.0), (4.0, 3.0, 0.0)),
        (Topology.MASTER, Role.SENDER, Leg(away_m=2.0), (-12.0, 0.0, 0.0)),
        (Topology.MASTER, Role.RELAY, Leg(left_m=3.0), (0.0, 3.0, 0.0)),
    ],
)
def test_a_post_is_relative_to_its_reference_robot(
    topology: Topology, reference: Role, leg: Leg, position_m: Vector
) -> None:
    placement = Placement(Scenario.LOS, topology, Distance(10.0, "10m"), (Post(RIVAL, reference, leg),))
    assert geometry.positions_m(placement)[RIVAL] == position_m
