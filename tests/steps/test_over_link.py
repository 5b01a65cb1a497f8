"""Steps that use one of several links: their commands, their errors, and the check of the route."""

import pytest

from fieldkit.backends.protocols import RobotLink
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.steps.base import Step
from fieldkit.steps.capabilities import HasNeeds, SendsTraffic
from fieldkit.steps.kinds.capture import CaptureStep
from fieldkit.steps.kinds.fault import FaultStep
from fieldkit.steps.kinds.iperf3 import Iperf3Step
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.kinds.send import SendStep
from fieldkit.steps.kinds.soak import SoakStep
from fieldkit.steps.over_link import judge_route
from fieldkit.steps.scene import CommandResult, Scene
from tests.helpers.casts import CAST, TURTLEBOT

LINKS = {"wifi": "wlan0", "cell": "wwan0", "either": "lo"}
PROFILE = TURTLEBOT.model_copy(update={"links": LINKS})


def ends(number: int) -> dict[str, RobotLink]:
    return {
        "cell": RobotLink(interface="wwan0", address=f"100.64.0.{number}"),
        "either": RobotLink(interface="lo", address=f"10.99.0.{number}"),
    }


LINKED = {
    role: CAST[role].model_copy(update={"profile": PROFILE, "links": ends(number)})
    for number, role in enumerate((Role.SENDER, Role.RECEIVER), start=1)
}
SCENE = Scene(Protocol.TCP, LINKED, "f")


def parse_step(kind: type[Step], text: str) -> Step:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), kind)


def commands(step: Step) -> list[str]:
    return [" ".join(planned.job.argv) for planned in step.jobs(SCENE)]


@pytest.mark.parametrize(
    ("kind", "keys", "address"),
    [
        (PingStep, "from: sender, to: receiver", "10.42.0.2"),
        (PingStep, "from: sender, to: receiver, over: wifi", "10.42.0.2"),
        (PingStep, "from: sender, to: receiver, over: cell", "100.64.0.2"),
        (PingStep, "from: sender, to: receiver, over: either", "10.99.0.2"),
        (SendStep, "from: sender, to: receiver, size: 5kB, over: cell", "100.64.0.2"),
        (Iperf3Step, "from: sender, to: receiver, over: cell", "100.64.0.2"),
    ],
)
def test_a_step_sends_to_the_address_on_its_link(kind: type[Step], keys: str, address: str) -> None:
    assert any(f" {address}" in command for command in commands(parse_step(kind, keys)))


def test_a_capture_and_a_fault_use_the_interface_of_their_link() -> None:
    step = parse_step(CaptureStep, "over: cell, during: [{ping: {from: sender, to: receiver, over: cell}}]")
    captures = commands(step)[:2]
    assert all(" -i wwan0 " in command for command in captures)
    assert all("host 100.64.0.1 and host 100.64.0.2" in command for command in captures)
    fault = parse_step(FaultStep, "robot: receiver, kind: link-down, link: cell, for: 5s")
    assert isinstance(fault, FaultStep)
    assert fault.cause.link == "cell"
    assert commands(fault)[0].endswith("-I wwan0 -i 0.1 100.64.0.2")


def test_a_capture_of_a_link_without_an_interface_is_on_all_interfaces() -> None:
    step = parse_step(CaptureStep, "over: either, during: [{ping: {from: sender, to: receiver, over: either}}]")
    assert all(" -i any " in command for command in commands(step)[:2])
    assert isinstance(step, CaptureStep)
    assert step.placement_error((), ()) is None
    assert all(need.argv[-2:] == ("-i", "any") for need in step.needs(SCENE))
    assert "host 10.99.0.1 and host 10.99.0.2" in commands(step)[0]


@pytest.mark.parametrize(
    ("keys", "is_captured", "reason"),
    [
        ("over: either, duplicates: true", True, None),
        ("over: either, duplicates: true", False, "a capture on both robots"),
        ("count: 10, duplicates: true", True, "needs `over`"),
        ("over: either, count: 65536, duplicates: true", True, "at most 65535 requests"),
        ("over: either, links: [wifi, cell]", True, None),
        ("over: either, links: [wifi]", False, "links needs `over`, and a capture on both robots"),
        ("over: either, count: 65536, links: [wifi]", True, "links allows at most 65535 requests"),
    ],
)
def test_columns_of_links_need_a_capture(keys: str, is_captured: bool, reason: str | None) -> None:
    step = parse_step(PingStep, f"from: sender, to: receiver, {keys}")
    capture = parse_step(CaptureStep, "over: either, during: [{wait: {duration: 1s}}]")
    assert isinstance(step, PingStep)
    assert isinstance(capture, CaptureStep)
    error = step.placement_error((), (capture,) if is_captured else ())
    assert error is None if reason is None else reason in (error or "")


@pytest.mark.parametrize(
    ("outer", "inner"), [("over: cell,", ""), ("", ", over: cell"), ("over: wifi,", ", over: cell")]
)
def test_a_capture_on_another_link_than_its_steps_is_rejected(outer: str, inner: str) -> None:
    step = parse_step(CaptureStep, f"{outer} during: [{{ping: {{from: sender, to: receiver{inner}}}}}]")
    assert isinstance(step, CaptureStep)
    assert "see `over`" in (step.placement_error((), ()) or "")


def test_a_link_that_a_robot_does_not_have_is_rejected_with_the_nearest_name() -> None:
    with pytest.raises(ConfigurationError, match=r"turtlebot-2 \(receiver\) has no link 'cel'") as error:
        commands(parse_step(PingStep, "from: sender, to: receiver, over: cel"))
    assert "cell" in error.value.remedy
    with pytest.raises(ConfigurationError, match="kind reboot does not allow the key link"):
        parse_step(FaultStep, "robot: receiver, kind: reboot, link: cell")


def test_a_link_with_columns_must_exist_on_both_robots() -> None:
    step = parse_step(PingStep, "from: sender, to: receiver, over: either, links: [cell, satellite]")
    with pytest.raises(ConfigurationError, match="has no link 'satellite'"):
        commands(step)


def test_flows_and_route_checks_name_the_link() -> None:
    step = parse_step(PingStep, "from: sender, to: receiver, over: cell")
    assert isinstance(step, SendsTraffic)
    assert isinstance(step, HasNeeds)
    assert [flow.link for flow in step.flows(SCENE)] == ["cell"]
    assert [need.argv for need in step.needs(SCENE)] == [
        ("ip", "-o", "route", "get", f"100.64.0.{n}") for n in (2, 1)
    ]
    for other in ("", ", over: wifi", ", over: either"):
        radio = parse_step(PingStep, f"from: sender, to: receiver{other}")
        assert isinstance(radio, HasNeeds)
        assert len(list(radio.needs(SCENE))) == (2 if "wifi" in other else 0)


@pytest.mark.parametrize(
    ("output", "code", "verdict"),
    [
        ("100.64.0.2 dev wwan0 src 100.64.0.1 uid 0 \\    cache", 0, Verdict.OK),
        ("100.64.0.2 via 10.0.0.1 dev eth0 src 10.0.0.5 uid 1000 \\    cache", 0, Verdict.FAIL),
        ("RTNETLINK answers: Network is unreachable", 2, Verdict.FAIL),
        ("", 127, Verdict.FAIL),
    ],
)
def test_the_route_must_use_the_interface_of_the_link(output: str, code: int, verdict: Verdict) -> None:
    sender_link, receiver_link = (LINKED[role].links["cell"] for role in (Role.SENDER, Role.RECEIVER))
    actual, _, remedy = judge_route(sender_link, receiver_link, CommandResult(output, code))
    assert actual is verdict
    assert ("ip route replace 100.64.0.2 dev wwan0" in remedy) == (verdict is Verdict.FAIL)


@pytest.mark.parametrize(
    ("kind", "keys"),
    [
        (PingStep, "from: sender, to: receiver"),
        (SendStep, "from: sender, to: receiver, size: 5kB"),
        (Iperf3Step, "from: sender, to: receiver"),
        (SoakStep, "from: sender, to: receiver, during: [{ping: {from: sender, to: receiver}}]"),
    ],
)
def test_each_sending_step_checks_the_routes_in_both_directions(kind: type[Step], keys: str) -> None:
    def routes(link: str) -> list[tuple[Role, str]]:
        step = parse_step(kind, f"{keys}{link}")
        assert isinstance(step, HasNeeds)
        return [(need.role, need.argv[-1]) for need in step.needs(SCENE) if "route" in need.argv]

    assert routes(", over: cell") == [(Role.SENDER, "100.64.0.2"), (Role.RECEIVER, "100.64.0.1")]
    assert routes(", over: either") == routes("") == []


def test_two_links_with_one_interface_are_rejected() -> None:
    data = TURTLEBOT.model_dump(mode="json", by_alias=True) | {"links": {"a": "wlan0", "b": "wlan0"}}
    with pytest.raises(schema.ValidationError, match="two links have the same interface"):
        RobotProfile.model_validate(data)
