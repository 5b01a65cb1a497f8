"""Random procedures on simulated evidence: each is measured correctly, or rejected when it is loaded."""

import json
import random
import tempfile
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.core.columns import Value, step_prefixed
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FIXED_ROLES, Protocol, RepeatId
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.trial import gates
from fieldkit.trial.procedure import PlacedStep, Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.casts import CAST
from tests.helpers.imagined import REFUSED, Attempt, AttemptTruth, TransferTruth
from tests.helpers.nightly import mark_nightly

HEAD = "name: any\nsummary: any\nscenario: los\ntopology: master\nprotocols: [tcp, udp]\nrepeats: 1\n"

ROLES = st.sampled_from([str(role) for role in FIXED_ROLES])
ENDS = st.sampled_from(
    [("sender", "receiver")] * 3 + [("receiver", "sender"), ("sender", "relay"), ("relay", "sender")]
)
PORTS = st.sampled_from([1234, 1234, 2222])
NAMES = st.sampled_from(["up", "down", "recv", "n{n}", "n{n}"])


def _optional_keys(**keys: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Return a strategy for mappings from which each key may be missing."""
    return st.fixed_dictionaries({}, optional=keys)


RECORD = st.builds(
    lambda robot, name: {"record": {"robot": robot, "topics": ["/scan"], "duration": "2s", **name}},
    st.sampled_from(["sender"] * 3 + ["receiver", "relay"]),
    _optional_keys(name=st.sampled_from(["scan", "lidar", "recv"])),
)
TRANSFER = st.builds(
    lambda ends, more: {"transfer": {"from": ends[0], "to": ends[1], **more}},
    ENDS,
    _optional_keys(
        name=NAMES,
        file=st.sampled_from(["scan", "scan.bag", "lidar.bag", "none.bin"]),
        into=st.sampled_from(["recv.bag", "other.bag", "scan.bag", "ping.txt", "sender.pcap", "track.csv"]),
        port=PORTS,
    ),
)
PING = st.builds(
    lambda ends, more: {"ping": {"from": ends[0], "to": ends[1], "count": 4, **more}},
    ENDS,
    _optional_keys(name=NAMES, payload_bytes=st.sampled_from([{"tcp": 502, "udp": 8192}, {"tcp": 8, "udp": 100}])),
)


IPERF3 = st.builds(
    lambda ends, more: {"iperf3": {"from": ends[0], "to": ends[1], "duration": "1s", **more}},
    ENDS,
    _optional_keys(
        name=NAMES,
        protocol=st.sampled_from(["tcp", "udp"]),
        reverse=st.booleans(),
        port=st.sampled_from([5201, 5202, 1234]),
    ),
)


ROBOTS = st.sampled_from(
    [["sender", "receiver"]] * 3 + [["sender"], ["relay", "sender"], ["relay", "sender", "receiver"]]
)


def _capture(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    keys = _optional_keys(name=NAMES, robots=ROBOTS, port=PORTS)
    return st.builds(lambda more, steps: {"capture": {**more, "during": steps}}, keys, during)


def _move(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    path_keys = {"path": [{"away": "5m"}], "speed": "0.1m/s"}
    keys = _optional_keys(name=NAMES)
    return st.builds(
        lambda robot, more, steps: {"move": {"robot": robot, **path_keys, **more, "during": steps}},
        ROLES,
        keys,
        during,
    )


def _fault(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    kinds = [{"kind": "link-down", "for": "1s"}, {"kind": "reboot"}, {"kind": "kill", "process": "nc"}]
    return st.builds(
        lambda robot, kind, more, steps: {"fault": {"robot": robot, **kind, **more, "during": steps}},
        ROLES,
        st.sampled_from(kinds),
        _optional_keys(name=NAMES),
        during,
    )


def _nests(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    during = st.lists(inner, min_size=1, max_size=3)
    return st.one_of(_capture(during), _move(during), _fault(during), _together(during), _for(during))


def _together(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    return st.builds(lambda steps: {"together": {"during": steps}}, during)


def _for(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    values = st.sampled_from([[1], [1, 2], ["a", "b"]])
    return st.builds(lambda each, steps: {"for": {"each": {"n": each}, "during": steps}}, values, during)


# Arbitrary procedures, most of which are rejected; and usual ones with random changes.
ANYTHING = st.lists(
    st.recursive(st.one_of(TRANSFER, PING, RECORD, IPERF3), _nests, max_leaves=4), min_size=1, max_size=3
)


def usual(seed: int) -> list[Any]:
    """Return a usual procedure with random changes."""
    draw = random.Random(seed)
    source, target = draw.choice([("sender", "receiver")] * 4 + [("receiver", "sender"), ("sender", "relay")])
    name = draw.choice(["scan", "scan", "lidar"])
    transfer: dict[str, Any] = {"from": source, "to": target}
    transfer |= draw.choice(
        [{}, {}, {}, {"into": "other.bag"}, {"into": f"{name}.bag"}, {"into": f"{target}-listen.log"}]
    )
    transfer |= draw.choice([{}, {}, {}, {"port": 2222}, {"file": f"{name}.bag"}, {"file": "none.bin"}])
    inside: list[Any] = [{"transfer": transfer}]
    if draw.random() < 0.7:
        options = draw.choice([{}, {"payload_bytes": {"tcp": 8, "udp": 100}}])
        ends = draw.choice([(source, target)] * 3 + [(target, source)])
        inside.append({"ping": {"from": ends[0], "to": ends[1], "count": 4, **options}})
    inside = _more(draw, inside, source, target)
    if draw.random() < 0.3:
        move = {"robot": draw.choice([source, "relay"]), "path": [{"away": "5m"}], "speed": "0.1m/s"}
        inside = [{"move": {**move, "during": inside}}]
    capture: dict[str, Any] = draw.choice([{}, {"robots": [source, target]}, {"robots": [source, target, "relay"]}])
    capture |= draw.choice([{}, {}, {"port": 1234}, {"port": 2222}, {"robots": [source]}])
    steps: list[Any] = [{"capture": {**capture, "during": inside}}]
    if draw.random() < 0.2:
        fault = draw.choice(
            [{"kind": "link-down", "for": "1s"}, {"kind": "reboot"}, {"kind": "kill", "process": "nc"}]
        )
        steps = [{"fault": {"robot": draw.choice([source, target]), **fault, "during": steps}}]
    recorder = draw.choice([source] * 12 + ["relay"])
    return [{"record": {"robot": recorder, "topics": ["/scan"], "duration": "2s", "name": name}}, *steps]


def _more(draw: random.Random, inside: list[Any], source: str, target: str) -> list[Any]:
    """Return the steps with further steps of the same kinds: in sequence, in parallel, or once for each value."""
    if draw.random() < 0.3:
        ping: dict[str, Any] = {"from": source, "to": target, "count": 3, "payload_bytes": "{bytes}"}
        ping |= draw.choice([{"name": "p{bytes}"}] * 4 + [{"name": "p"}, {"name": "p{byte}"}])
        inside = [*inside, {"for": {"each": {"bytes": [100, 502, 8192]}, "during": [{"ping": ping}]}}]
    if draw.random() < 0.4:
        ends = draw.choice([(source, target), (source, target), (target, source)])
        port = draw.choice([3333, 3333, 3333, 1234])
        inside = [*inside, {"transfer": {"from": ends[0], "to": ends[1], "name": "more", "port": port}}]
    for name in draw.choice([[]] * 5 + [["a"], ["a", "b"], ["a", "b", "c"]]):
        ends = draw.choice([(source, target), (target, source)])
        load: dict[str, Any] = {"from": ends[0], "to": ends[1], "name": name, "duration": "1s"}
        load |= {"protocol": draw.choice(["tcp", "udp"]), "reverse": draw.random() < 0.5}
        inside = [*inside, {"iperf3": load | draw.choice([{}, {}, {"port": 5202}, {"port": 1234}])}]
    if draw.random() < 0.5 and len(inside) > 1:
        inside = [{"together": {"during": inside}}]
    if draw.random() < 0.2:
        inside = [{"capture": {"name": "inner", "during": inside}}]
    return inside


OTHER_STEPS = {
    "protocol": st.sampled_from(list(Protocol)),
    "loss": st.sampled_from([0.0, 0.2]),
    "seed": st.integers(0, 99),
}

OUTCOMES: Counter[str] = Counter()


def loaded(steps: list[Any]) -> Procedure | ConfigurationError:
    """Return the procedure, or the error with which it is rejected."""
    text = f"{HEAD}steps: {json.dumps(steps, indent=1)}\n"
    try:
        return schema.validate(schema.parse(text, source="any.yaml"), Procedure)
    except ConfigurationError as error:
        return error


@pytest.mark.emulated  # needs tcpdump, which filters the captures
@given(steps=ANYTHING, **OTHER_STEPS)
def test_any_procedure_is_measured_correctly_or_rejected(
    steps: list[Any], protocol: Protocol, loss: float, seed: int
) -> None:
    judge(steps, protocol, loss, seed)


@pytest.mark.emulated
@pytest.mark.parametrize("block", mark_nightly(range(4), in_ci=(0, 1)))
def test_usual_procedures_are_measured_correctly_or_rejected(block: int) -> None:
    for seed in range(100 * block, 100 * block + 100):
        draw = random.Random(seed)
        judge(usual(seed), draw.choice(list(Protocol)), draw.choice([0.0, 0.2]), seed)


def judge(steps: list[Any], protocol: Protocol, loss: float, seed: int) -> None:
    """Load a procedure; if it is valid, simulate it, measure it, and compare the result with the truth."""
    procedure = loaded(steps)
    if isinstance(procedure, ConfigurationError):
        OUTCOMES["refused when loaded"] += 1
        assert int(procedure.where.removeprefix("any.yaml:")) > HEAD.count("\n"), "the line of a step"
        assert procedure.remedy
        return
    request = TrialRequest(procedure=procedure, distance=parse_distance("30ft"))
    plan = make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, tzinfo=UTC))
    if plan.refusals({}):
        OUTCOMES["refused by a preflight check"] += 1
        return
    with tempfile.TemporaryDirectory() as folder:
        repeat = RepeatId(protocol, 1)
        truth = Attempt(plan, repeat, Path(folder), loss, random.Random(seed)).write_evidence_of_steps()
        verdict = gates.judge(plan, repeat, AttemptEvidence(Path(folder)))
    assert verdict.problems == ()
    OUTCOMES["valid"] += 1
    _compare(procedure, protocol, truth, verdict.measured.values, verdict.measured.missing)


def _compare(
    procedure: Procedure,
    protocol: Protocol,
    truth: AttemptTruth,
    values: Mapping[str, Value],
    missing: Mapping[str, str],
) -> None:
    declared = [
        step_prefixed(placed.step.prefix, column.name)
        for placed in procedure.walk()
        for column in placed.step.output_columns()
    ]
    assert len(set(declared)) == len(declared)
    assert set(declared) <= values.keys() | missing.keys()
    assert all(missing.get(name, "for a reason") for name in declared)
    for name, (requests, answered) in truth.pings.items():
        assert (values[step_prefixed(name, "rtt_sent")], values[step_prefixed(name, "rtt_received")]) == (
            requests,
            answered,
        )
    for name, (sent, received) in truth.loads.items():
        for end, packets in (("sent", sent), ("received", received)):
            assert values[step_prefixed(name, f"iperf3_{end}_bytes")] == 1400 * packets
        loss, cookie_bytes = step_prefixed(name, "iperf3_captured_loss"), truth.cookies_bytes[name]
        sent_bytes, came_bytes = (1400 * packets + cookie_bytes for packets in (sent, received))
        assert loss in missing or values[loss] == 1 - came_bytes / sent_bytes
        OUTCOMES["valid, iperf3 captured"] += loss in values
    OUTCOMES["valid, two pings or more"] += len(truth.pings) > 1
    OUTCOMES["valid, two transfers or more"] += len(truth.transfers) > 1
    OUTCOMES["valid, at the same time"] += any(nest.parallel for placed in procedure.walk() for nest in placed.within)
    for placed in procedure.walk():
        if isinstance(placed.step, TransferStep):
            sent_file = truth.transfers[placed.step.prefix]
            _compare_transfer(placed, protocol, sent_file, values, missing)
            refused = step_prefixed(placed.step.prefix, "receiver_udp_buffer_errors")
            others = truth.udp_to.count(sent_file.target) - (protocol is Protocol.UDP)
            assert "one counter for all datagrams" in missing[refused] if others else values[refused] == REFUSED
            OUTCOMES["valid, UDP of several to one"] += bool(others)


def _compare_transfer(
    placed: PlacedStep,
    protocol: Protocol,
    sent: TransferTruth,
    values: Mapping[str, Value],
    missing: Mapping[str, str],
) -> None:
    step = placed.step
    assert isinstance(step, TransferStep)

    def value(column: str) -> Value:
        return values[step_prefixed(step.prefix, column)]

    assert (value("sent_bytes"), value("received_bytes")) == (sent.sent_bytes, sent.received_bytes)
    assert value("file_loss") == 1 - sent.received_bytes / sent.sent_bytes
    if (packets := step_prefixed(step.prefix, "paper_packets")) in values and protocol is Protocol.UDP:
        assert values[packets] == -(-sent.sent_bytes // 8192)
    captured = {role for nest in placed.within for role in nest.captures()}
    if not {step.sender, step.receiver} <= captured:
        OUTCOMES["valid, transfer not captured at both ends"] += 1
        assert step_prefixed(step.prefix, "byte_loss") in missing
    elif protocol is Protocol.UDP:
        OUTCOMES["valid, UDP captured"] += 1
        assert value("ip_packets_sent") == sent.packets_sent
        assert value("ip_loss") == 1 - (sent.packets_sent - sent.packets_lost) / sent.packets_sent
    else:
        OUTCOMES["valid, TCP captured"] += 1
        assert value("tcp_retransmitted_segments") == sent.retransmitted
        assert value("byte_loss") == 0


@pytest.mark.emulated
def test_enough_procedures_of_each_kind_were_tried(record_property: Any) -> None:  # noqa: ANN401 (of pytest)
    if not OUTCOMES:
        pytest.fail("this runs behind the test above, in one process")
    record_property("result", f"random procedures: {dict(sorted(OUTCOMES.items()))}")
    assert (
        min(OUTCOMES[outcome] for outcome in ("refused when loaded", "valid, UDP captured", "valid, TCP captured"))
        >= 20
    )
    assert min(OUTCOMES[outcome] for outcome in ("valid, two pings or more", "valid, two transfers or more")) >= 8
    assert min(OUTCOMES[outcome] for outcome in ("valid, at the same time", "valid, iperf3 captured")) >= 10
    assert OUTCOMES["valid, UDP of several to one"] >= 5
