"""A trial takes few round trips on a slow control link: independent work is parallel, and no query is repeated."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import pytest

from benchmarks.slow_links import slow_control
from fieldkit.backends.registry import load_backend
from fieldkit.config import schema
from fieldkit.config.site import Site
from fieldkit.core.events import Event, RepeatEnded
from fieldkit.core.model import Protocol, Status, Topology
from fieldkit.core.prompts import Unattended
from fieldkit.core.units import parse_distance
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.opening import opened
from fieldkit.trial.running.runner import run_trial
from tests.helpers import texts
from tests.helpers.labs import site_with_late_packets

pytestmark = pytest.mark.emulated

# Longer than threads wait for each other, so that parallel work can be observed.
ROUND_TRIP_S: Final = 0.3
PER_REPEAT: Final = 12
TO_OPEN: Final = 13
"""Round trips to log in, check for the script, copy it, and lock the robots in order."""

PROCEDURE: Final = texts.procedure(
    "trips",
    """\
- record: {robot: sender, topics: [/scan], duration: 500ms, name: scan}
- capture:
    robots: [sender, receiver]
    during:
      - transfer: {from: sender, to: receiver, idle: 1s}
- ping: {from: sender, to: receiver, count: 3, interval: 20ms}
""",
    repeats=2,
)


def test_connecting_and_each_repeat_take_few_sequential_round_trips(tmp_path: Path) -> None:
    procedure = schema.validate(schema.parse(PROCEDURE, source="procedure"), Procedure)
    document = schema.parse(site_with_late_packets(), source="fieldkit.yaml")
    backend = load_backend("emulated", schema.validate(document, Site), document)
    cast = backend.cast(Topology.MASTERLESS)
    request = TrialRequest(procedure, parse_distance("5m"), topology=Topology.MASTERLESS)
    plan = make_plan(request, backend="emulated", cast=cast, now=datetime.now(UTC))
    assert plan.procedure.protocols == (Protocol.TCP,)
    with slow_control(ROUND_TRIP_S) as slow:
        trips_after_repeats: list[int] = []

        def sink(event: Event) -> None:
            if isinstance(event, RepeatEnded):
                assert event.status is Status.VALID, event.reason
                trips_after_repeats.append(slow.trips)

        robots = opened(
            backend, cast, session=plan.session, purpose=plan.trial, seed=1, sink=sink, operator=Unattended()
        )
        with robots as testbed:
            assert slow.trips <= TO_OPEN
            run_trial(plan, testbed, tmp_path, sink)
    first, second = trips_after_repeats
    assert 0 < second - first <= PER_REPEAT
