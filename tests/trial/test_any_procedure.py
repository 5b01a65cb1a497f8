"""Random procedures with simulated evidence: each is measured correctly, or rejected when it is loaded."""

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
    lambda ends, options: {"transfer": {"from": ends[0], "to": ends[1], **options}},
    ENDS,
    _optional_keys(
        name=NAMES,
        file=st.sampled_from(["scan", "scan.bag", "lidar.bag", "none.bin"]),
        into=st.sampled_from(["recv.bag", "other.bag", "scan.bag", "ping.txt", "sender.pcap", "track.csv"]),
        port=PORTS,
    ),
)
PING = st.builds(
    lambda ends, options: {"ping": {"from": ends[0], "to": ends[1], "count": 4, **options}},
    ENDS,
    _optional_keys(name=NAMES, payload_bytes=st.sampled_from([{"tcp": 502, "udp": 8192}, {"tcp": 8, "udp": 100}])),
)


IPERF3 = st.builds(
    lambda ends, options: {"iperf3": {"from": ends[0], "to": ends[1], "duration": "1s", **options}},
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
    return st.builds(lambda options, steps: {"capture": {**options, "during": steps}}, keys, during)


def _move(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    path_keys = {"path": [{"away": "5m"}], "speed": "0.1m/s"}
    keys = _optional_keys(name=NAMES)
    return st.builds(
        lambda robot, options, steps: {"move": {"robot": robot, **path_keys, **options, "during": steps}},
        ROLES,
        keys,
        during,
    )


def _fault(during: st.SearchStrategy[list[Any]]) -> st.SearchStrategy[Any]:
    kinds = [{"kind": "link-down", "for": "1s"}, {"kind": "reboot"}, {"kind": "kill", "process": "nc"}]
    return st.builds(
        lambda robot, kind, options, steps: {"fault": {"robot": robot, **kind, **options, "during": steps}},
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


# The tests use arbitrary procedures, of which most are rejected, and usual procedures with random changes.
ANYTHING = st.lists(
    st.recursive(st.one_of(TRANSFER, PING, RECORD, IPERF3), _nests, max_leaves=4), min_size=1, max_size=3
)


def usual_steps(seed: int) -> list[Any]:
    """Return the steps of a usual procedure with random changes."""
    draw = random.Random(seed)
    source, target = draw.choice([("sender", "receiver")] * 4 + [("receiver", "sender"), ("sender", "relay")])
    name = draw.choice(["scan", "scan", "lidar"])
    transfer: dict[str, Any] = {"from": source, "to": target}
    transfer |= draw.choice(
        [{}, {}, {}, {"into": "other.bag"}, {"into": f"{name}.bag"}, {"into": f"{target}-listen.log"}]
    )
    transfer |= draw.choice([{}, {}, {}, {"port": 2222}, {"file": f"{name}.bag"}, {"file": "none.bin"}])
    inner_steps: list[Any] = [{"transfer": transfer}]
    if draw.random() < 0.7:
        options = draw.choice([{}, {"payload_bytes": {"tcp": 8, "udp": 100}}])
        ends = draw.choice([(source, target)] * 3 + [(target, source)])
        inner_steps.append({"ping": {"from": ends[0], "to": ends[1], "count": 4, **options}})
    inner_steps = _add_steps(draw, inner_steps, source, target)
    if draw.random() < 0.3:
        move = {"robot": draw.choice([source, "relay"]), "path": [{"away": "5m"}], "speed": "0.1m/s"}
        inner_steps = [{"move": {**move, "during": inner_steps}}]
    capture: dict[str, Any] = draw.choice([{}, {"robots": [source, target]}, {"robots": [source, target, "relay"]}])
    capture |= draw.choice([{}, {}, {"port": 1234}, {"port": 2222}, {"robots": [source]}])
    steps: list[Any] = [{"capture": {**capture, "during": inner_steps}}]
    if draw.random() < 0.2:
        fault = draw.choice(
            [{"kind": "link-down", "for": "1s"}, {"kind": "reboot"}, {"kind": "kill", "process": "nc"}]
        )
        steps = [{"fault": {"robot": draw.choice([source, target]), **fault, "during": steps}}]
    recorder = draw.choice([source] * 12 + ["relay"])
    return [{"record": {"robot": recorder, "topics": ["/scan"], "duration": "2s", "name": name}}, *steps]


def _add_steps(draw: random.Random, inner_steps: list[Any], source: str, target: str) -> list[Any]:
    """Return the steps, perhaps with more of the same kinds: in sequence, in parallel, or once for each value."""
    if draw.random() < 0.3:
        ping: dict[str, Any] = {"from": source, "to": target, "count": 3, "payload_bytes": "{bytes}"}
        ping |= draw.choice([{"name": "p{bytes}"}] * 4 + [{"name": "p"}, {"name": "p{byte}"}])
        inner_steps = [*inner_steps, {"for": {"each": {"bytes": [100, 502, 8192]}, "during": [{"ping": ping}]}}]
    if draw.random() < 0.4:
        ends = draw.choice([(source, target), (source, target), (target, source)])
        port = draw.choice([3333, 3333, 3333, 1234])
        inner_steps = [*inner_steps, {"transfer": {"from": ends[0], "to": ends[1], "name": "more", "port": port}}]
    for name in draw.choice([[]] * 5 + [["a"], ["a", "b"], ["a", "b", "c"]]):
        ends = draw.choice([(source, target), (target, source)])
        load: dict[str, Any] = {"from": ends[0], "to": ends[1], "name": name, "duration": "1s"}
        load |= {"protocol": draw.choice(["tcp", "udp"]), "reverse": draw.random() < 0.5}
        inner_steps = [*inner_steps, {"iperf3": load | draw.choice([{}, {}, {"port": 5202}, {"port": 1234}])}]
    if draw.random() < 0.5 and len(inner_steps) > 1:
        inner_steps = [{"together": {"during": inner_steps}}]
    if draw.random() < 0.2:
        inner_steps = [{"capture": {"name": "inner", "during": inner_steps}}]
    return inner_steps


RANDOM_CONDITIONS = {
    "protocol": st.sampled_from(list(Protocol)),
    "loss": st.sampled_from([0.0, 0.2]),
    "seed": st.integers(0, 99),
}

OUTCOMES: Counter[str] = Counter()


def load(steps: list[Any]) -> Procedure | ConfigurationError:
    """Return the procedure, or the error with which it is rejected."""
    text = f"{HEAD}steps: {json.dumps(steps, indent=1)}\n"
    try:
        return schema.validate(schema.parse(text, source="any.yaml"), Procedure)
    except ConfigurationError as error:
        return error


@pytest.mark.emulated  # needs tcpdump, which filters the captures
@given(steps=ANYTHING, **RANDOM_CONDITIONS)
def test_any_procedure_is_measured_correctly_or_rejected(
    steps: list[Any], protocol: Protocol, loss: float, seed: int
) -> None:
    judge(steps, protocol, loss, seed)


@pytest.mark.emulated
@pytest.mark.parametrize("block", mark_nightly(range(4), in_ci=(0, 1)))
def test_usual_procedures_are_measured_correctly_or_rejected(block: int) -> None:
    for seed in range(100 * block, 100 * block + 100):
        draw = random.Random(seed)
        judge(usual_steps(seed), draw.choice(list(Protocol)), draw.choice([0.0, 0.2]), seed)


def judge(steps: list[Any], protocol: Protocol, loss: float, seed: int) -> None:
    """Load a procedure; if it is valid, simulate it, measure it, and compare the result with the truth."""
    procedure = load(steps)
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
    column_names = [
        step_prefixed(placed.step.prefix, column.name)
        for placed in procedure.walk()
        for column in placed.step.output_columns()
    ]
    assert len(set(column_names)) == len(column_names)
    assert set(column_names) <= values.keys() | missing.keys()
    assert all(missing.get(name, "for a reason") for name in column_names)
    for name, (requests, replies) in truth.pings.items():
        assert (values[step_prefixed(name, "rtt_sent")], values[step_prefixed(name, "rtt_received")]) == (
            requests,
            replies,
        )
    for name, (sent_packets, received_packets) in truth.loads.items():
        for end, packets in (("sent", sent_packets), ("received", received_packets)):
            assert values[step_prefixed(name, f"iperf3_{end}_bytes")] == 1400 * packets
        loss, cookie_bytes = step_prefixed(name, "iperf3_captured_loss"), truth.cookies_bytes[name]
        sent_bytes, received_bytes = (1400 * packets + cookie_bytes for packets in (sent_packets, received_packets))
        assert loss in missing or values[loss] == 1 - received_bytes / sent_bytes
        OUTCOMES["valid, iperf3 captured"] += loss in values
    OUTCOMES["valid, two pings or more"] += len(truth.pings) > 1
    OUTCOMES["valid, two transfers or more"] += len(truth.transfers) > 1
    OUTCOMES["valid, at the same time"] += any(nest.parallel for placed in procedure.walk() for nest in placed.within)
    for placed in procedure.walk():
        if isinstance(placed.step, TransferStep):
            transfer = truth.transfers[placed.step.prefix]
            _compare_transfer(placed, protocol, transfer, values, missing)
            buffer_errors = step_prefixed(placed.step.prefix, "receiver_udp_buffer_errors")
            other_transfers = truth.udp_to.count(transfer.target) - (protocol is Protocol.UDP)
            assert (
                "one counter for all datagrams" in missing[buffer_errors]
                if other_transfers
                else values[buffer_errors] == REFUSED
            )
            OUTCOMES["valid, UDP of several to one"] += bool(other_transfers)


def _compare_transfer(
    placed: PlacedStep,
    protocol: Protocol,
    transfer_truth: TransferTruth,
    values: Mapping[str, Value],
    missing: Mapping[str, str],
) -> None:
    step = placed.step
    assert isinstance(step, TransferStep)

    def value(column: str) -> Value:
        return values[step_prefixed(step.prefix, column)]

    assert (value("sent_bytes"), value("received_bytes")) == (
        transfer_truth.sent_bytes,
        transfer_truth.received_bytes,
    )
    assert value("file_loss") == 1 - transfer_truth.received_bytes / transfer_truth.sent_bytes
    if (packets := step_prefixed(step.prefix, "paper_packets")) in values and protocol is Protocol.UDP:
        assert values[packets] == -(-transfer_truth.sent_bytes // 8192)
    capturing_roles = {role for nest in placed.within for role in nest.captures()}
    if not {step.sender, step.receiver} <= capturing_roles:
        OUTCOMES["valid, transfer not captured at both ends"] += 1
        assert step_prefixed(step.prefix, "byte_loss") in missing
    elif protocol is Protocol.UDP:
        OUTCOMES["valid, UDP captured"] += 1
        assert value("ip_packets_sent") == transfer_truth.packets_sent
        assert (
            value("ip_loss")
            == 1 - (transfer_truth.packets_sent - transfer_truth.packets_lost) / transfer_truth.packets_sent
        )
    else:
        OUTCOMES["valid, TCP captured"] += 1
        assert value("tcp_retransmitted_segments") == transfer_truth.retransmitted
        assert value("byte_loss") == 0


@pytest.mark.emulated
def test_enough_random_procedures_of_each_kind_were_measured(record_property: Any) -> None:  # noqa: ANN401 (of pytest)
    if not OUTCOMES:
        pytest.fail("this test needs the results of the tests before it, in the same process")
    record_property("result", f"random procedures: {dict(sorted(OUTCOMES.items()))}")
    assert (
        min(OUTCOMES[outcome] for outcome in ("refused when loaded", "valid, UDP captured", "valid, TCP captured"))
        >= 20
    )
    assert min(OUTCOMES[outcome] for outcome in ("valid, two pings or more", "valid, two transfers or more")) >= 8
    assert min(OUTCOMES[outcome] for outcome in ("valid, at the same time", "valid, iperf3 captured")) >= 10
    assert OUTCOMES["valid, UDP of several to one"] >= 5
