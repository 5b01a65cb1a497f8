"""The channel of the ns-3 federate has the losses of the built-in radio, also from jammers."""

import json
import random
import subprocess
from typing import Any

import pytest

from fieldkit.config import schema
from sim_backends.ns3.federate import command
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.world import World

# The names need escapes in JSON, which is the key of the draws, and are not in alphabetical order.
NAMES = ("rover", "drone", 'Übung "7"')
PLACES = 25
WORLD_FILE = """\
name: all
summary: every kind of obstacle
area_m: [60, 60]
obstacles:
  - {kind: box, name: b, centre_m: [30, 30], size_m: [20, 9, 3], yaw_deg: 30, material: glass}
  - {kind: wall, name: w, from_m: [5, 5], to_m: [50, 20], height: 3m, thickness: 0.3m, material: metal}
  - {kind: building, name: h, centre_m: [15, 40], size_m: [10, 8, 4], yaw_deg: 10, thickness: 0.2m, material: brick}
  - {kind: tree, name: t, at_m: [40, 45], height: 9m, crown_base: 0.5m, crown_radius: 18m, trunk_radius: 0.4m}
  - {kind: raised, name: k, centre_m: [50, 30], size_m: [12, 12, 1.5], yaw_deg: 20}
  - {kind: ramp, name: r, centre_m: [30, 10], size_m: [12, 12, 2], yaw_deg: -70}
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    path = tmp_path_factory.mktemp("world") / "all.yaml"
    path.write_text(WORLD_FILE, encoding="utf-8")
    return schema.load(path, World)


@pytest.mark.parametrize(
    "options",
    [
        {"shadowing_db": 6, "decorrelation": "7m", "k_db": 3, "stir_m_s": 0.3},
        {"propagation": "two-ray", "fading": False},
        {"propagation": "free-space", "exponent": 2.2},
    ],
    ids=str,
)
def test_losses_in_ns3_equal_those_of_the_built_in_radio(options: dict[str, Any], world: World) -> None:
    radio, rng = RadioOptions.model_validate(options), random.Random(3)
    channel = WorldChannel(9, dict.fromkeys(NAMES, Antenna("802.11g", 0.0, -82.0)), radio, world)
    links, expected_mw = [], []
    jammer_links, jammer_mw = [], []
    for _ in range(PLACES):
        at_ns = rng.randrange(10**11)
        places = {name: (rng.uniform(0, 60), rng.uniform(0, 60), rng.choice((0.4, 1.0, 6.0))) for name in NAMES}
        channel.move(at_ns, places)
        for first, name in enumerate(NAMES):
            powers_mw = channel.powers_mw(first, at_ns)
            for second, other in enumerate(NAMES):
                if first != second and powers_mw[second] > 0:  # the loss in metal may exceed the range of a float
                    links.append((at_ns, first, places[name], second, places[other]))
                    expected_mw.append(powers_mw[second])
        jammer_m = rng.uniform(0, 60), rng.uniform(0, 60), 1.0
        for name, power_mw in zip(NAMES, channel.received_mw(jammer_m, 0.0), strict=True):
            if power_mw > 0:
                jammer_links.append((jammer_m, places[name]))
                jammer_mw.append(power_mw)
    request = {
        "seed": 9,
        "radio": radio.model_dump(mode="json", exclude_none=True),
        "world": world.model_dump(mode="json", by_alias=True, exclude_none=True),
        "names": NAMES,
        "links": links,
        "places": jammer_links,
    }
    output = subprocess.run(
        [*command().split(), "losses"], input=json.dumps(request), capture_output=True, text=True, check=True
    )
    powers_mw = [10 ** (-loss_db / 10) for loss_db in json.loads(output.stdout)]
    assert len(powers_mw) > 2 * PLACES
    assert powers_mw == pytest.approx([*expected_mw, *jammer_mw], rel=1e-9, abs=0)
