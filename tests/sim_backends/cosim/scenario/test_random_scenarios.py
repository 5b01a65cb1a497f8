"""Any scenario within the schema either runs, or is refused before the run with a location and a remedy."""

import json
import re
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.policies.sync_policy import PolicyError
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario

NAMES = ("one", "two", "three", "four")
UNTIL_NS = 30_000_000


def optional_keys(**values: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Return a strategy for mappings that have any of these keys."""
    return st.fixed_dictionaries({}, optional=values)


def entry_of_kind(
    name: str, required_entries: dict[str, Any], **optional_entries: st.SearchStrategy[Any]
) -> st.SearchStrategy[Any]:
    return st.fixed_dictionaries({"kind": st.just(name), **required_entries}, optional=optional_entries)


def quantities(unit: str, *values: float) -> st.SearchStrategy[str]:
    return st.sampled_from(values).map(lambda value: f"{value:g}{unit}")


AGENT = st.sampled_from((*NAMES * 10, "five"))
PLACES = st.tuples(st.integers(0, 40), st.integers(0, 40)).map(list)
TIMES = quantities("ms", 0, 1, 5, 12.5, 20)
ENDPOINT_KEYS = {"from": AGENT, "to": st.lists(AGENT, min_size=1, max_size=3) | AGENT}
SENDER_KEYS = {
    "protocol": st.sampled_from(("udp", "udp", "tcp", "topic", "ros1", "ros1-udp")),
    "start": TIMES,
    "qos": optional_keys(reliability=st.sampled_from(("reliable", "best_effort")), depth=st.integers(1, 5)),
}
LEGS = st.fixed_dictionaries(
    {"duration": quantities("ms", 3, 10)},
    optional={
        "speed": quantities("m/s", 0, 0.5),
        # A robot that flies cannot turn, and a robot that drives cannot climb.
        "turn_deg_s": st.sampled_from((0, 0, 0, -30, 15)),
        "climb_m_s": st.sampled_from((0, 0, 0, -2, 1)),
    },
)
MOTIONS = st.one_of(
    entry_of_kind("standing", {}),
    entry_of_kind("station-keeping", {}),
    entry_of_kind("velocity-profile", {"legs": st.lists(LEGS, min_size=1, max_size=3)}),
    entry_of_kind(
        "follow", {"leader": AGENT | st.lists(AGENT, min_size=1, max_size=2), "distance": quantities("m", 1, 3)}
    ),
    entry_of_kind(
        "way-points",
        {"points_m": st.lists(PLACES, min_size=1, max_size=3), "speed": quantities("m/s", 0.2, 5)},
        relative=st.booleans(),
        wait=TIMES,
    ),
)
ROBOTS = st.sampled_from((*("turtlebot3_burger", "duckiedrone") * 10, "husky", "rover"))


def agents(east_m: int) -> st.SearchStrategy[dict[str, Any]]:
    """Return a strategy for agents that start near an easting, so that few overlap."""
    places = st.tuples(st.integers(east_m, east_m + 10), st.integers(0, 40)).map(list)
    flying = {"robot": st.sampled_from(("iris", "duckiedrone")), "along": quantities("m", east_m, east_m + 5)}
    radio = optional_keys(tx_power_dbm=st.integers(0, 20), standard=st.sampled_from(("802.11n", "802.11g")))
    return st.fixed_dictionaries(
        {"robot": ROBOTS, "at_m": places}, optional={"radio": radio, "motion": MOTIONS}
    ) | st.fixed_dictionaries(
        flying | {"radio": radio},
        optional={"height": quantities("m", 0, 3), "motion": MOTIONS, "aside_m": st.integers(-9, 9)},
    )


TRAFFIC = st.one_of(
    entry_of_kind(
        "stream",
        ENDPOINT_KEYS | {"rate": quantities("Hz", 30, 999.9)},
        **SENDER_KEYS,
        size_bytes=st.integers(1, 3000),
    ),
    entry_of_kind("bag", ENDPOINT_KEYS, **SENDER_KEYS, jitter=TIMES),
    entry_of_kind("file", ENDPOINT_KEYS | {"size_bytes": st.integers(1, 20_000)}, **SENDER_KEYS),
    entry_of_kind("ping", ENDPOINT_KEYS, **SENDER_KEYS, interval=quantities("ms", 5, 10), count=st.integers(1, 9)),
)
INTERVAL_KEYS = {"from": TIMES, "to": TIMES}
FAULTS = st.one_of(
    entry_of_kind("node-loss", {"agent": AGENT}, **INTERVAL_KEYS),
    entry_of_kind("link-cut", {"between": st.lists(AGENT, min_size=2, max_size=2)}, **INTERVAL_KEYS),
    entry_of_kind("jammer", {"power_dbm": st.integers(-50, 40)}, **INTERVAL_KEYS, at_m=PLACES, agent=AGENT),
    entry_of_kind(
        "clock-skew",
        {"agent": AGENT},
        **INTERVAL_KEYS,
        offset_ms=st.integers(-10, 10),
        rate_ppm=st.integers(-100_000, 100_000),
    ),
)
SCENARIOS = st.fixed_dictionaries(
    {
        "name": st.just("any"),
        "summary": st.just("of a test"),
        "world": st.sampled_from(("open", "open", "baylands", "lawn")),
        "duration": st.just("1s"),
        "agents": st.fixed_dictionaries({name: agents(10 * number) for number, name in enumerate(NAMES)}),
    },
    optional={
        "line": st.sampled_from(("los", "nlos")),
        "physics": optional_keys(step=quantities("ms", 0.5, 1)),
        "policy": optional_keys(
            name=st.sampled_from([*BUILTIN]), window=quantities("ms", 1, 3.7), bound=quantities("cm", 0.1, 5)
        ),
        "topology": st.sampled_from(("master", "masterless")),
        "relay": AGENT,
        "radio": optional_keys(fading=st.booleans(), loss=st.just("10%"), queue_packets=st.integers(0, 3)),
        "traffic": st.lists(TRAFFIC, max_size=4),
        "faults": st.lists(FAULTS, max_size=3),
    },
)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(SCENARIOS)
def test_any_scenario_runs_or_is_refused_with_a_location_and_a_remedy(tmp_path: Path, data: dict[str, Any]) -> None:
    path = tmp_path / "any.yaml"
    path.write_text(json.dumps(data, indent=1), encoding="utf-8")
    caught: ConfigurationError | None = None
    try:
        scenario = load_scenario(path)
        runs = [build(scenario).run(UNTIL_NS) for _ in range(2)]
    except ConfigurationError as error:
        caught = error
    if caught is None:
        event("runs")
        assert runs[0].windows_ns[-1] == UNTIL_NS
        assert runs[0].digest == runs[1].digest
    elif isinstance(caught, PolicyError):
        event("the rule as printed stops")
        assert scenario.policy.name == "velocity_aware_raw"
    else:
        event(re.sub(r"[0-9.]+", "N", caught.what)[:70])
        assert caught.where.startswith(f"{path}:")
        assert caught.remedy
