"""A trial can only be resumed with the same code, the same backend and the same robots."""

from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.model import Role
from fieldkit.trial.procedure import Procedure, load_procedure
from fieldkit.trial.running import resumption
from fieldkit.trial.stored import plans
from tests.helpers.stored_trials import TRIALS

TRIAL: Path = min(TRIALS.iterdir())
PLAN = plans.read_plan(TRIAL)


def test_a_trial_is_not_resumed_with_different_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resumption, "code_hash", lambda: PLAN.code_sha256)
    assert resumption.resumable(TRIAL) == PLAN
    monkeypatch.setattr(resumption, "code_hash", lambda: "another")
    with pytest.raises(
        ConfigurationError, match=f"started with other code .fieldkit .*, {PLAN.code_sha256}"
    ) as caught:
        resumption.resumable(TRIAL)
    assert caught.value.where == str(TRIAL)
    assert shell_command("fieldkit", "rebuild", TRIAL) in caught.value.remedy


def test_robots_of_another_backend_are_rejected() -> None:
    resumption.require_backend(PLAN, PLAN.backend, TRIAL)
    with pytest.raises(ConfigurationError, match=f"it was started on backend {PLAN.backend}, not imagined") as caught:
        resumption.require_backend(PLAN, "imagined", TRIAL)
    assert caught.value.remedy == shell_command("fieldkit", "resume", TRIAL, "--backend", PLAN.backend)


def test_other_simulators_are_rejected() -> None:
    resumption.require_simulators(PLAN, {}, TRIAL)
    simulated_plan = PLAN.model_copy(update={"simulators": {"physics": "mujoco", "network": "ns3"}})
    resumption.require_simulators(simulated_plan, {"network": "ns3", "physics": "mujoco"}, TRIAL)
    with pytest.raises(ConfigurationError, match="was started on physics mujoco, network ns3, not on no simulators"):
        resumption.require_simulators(simulated_plan, {}, TRIAL)
    with pytest.raises(ConfigurationError, match="was started on no simulators, not on network ns3"):
        resumption.require_simulators(PLAN, {"network": "ns3"}, TRIAL)


@pytest.mark.parametrize("change", [{"name": "other"}, {"address": "10.42.0.99"}, None])
def test_other_robots_are_rejected(change: dict[str, str] | None) -> None:
    resumption.require_cast(PLAN, PLAN.cast)
    changed_cast = dict(PLAN.cast)
    sender = changed_cast.pop(Role.SENDER)
    if change is not None:
        changed_cast[Role.SENDER] = sender.model_copy(update=change)
    with pytest.raises(ConfigurationError, match=f"sender was {sender.name} ") as caught:
        resumption.require_cast(PLAN, changed_cast)
    assert caught.value.where == PLAN.trial


@pytest.mark.motion
def test_a_self_moving_robot_needs_permission_again() -> None:
    driving_procedure = load_procedure("driveaway")
    driving_cast = {
        role: robot.model_copy(update={"abilities": frozenset({"drive"})}) for role, robot in PLAN.cast.items()
    }
    carried_cast = {role: robot.model_copy(update={"abilities": frozenset()}) for role, robot in PLAN.cast.items()}
    plan = PLAN.model_copy(update={"procedure": driving_procedure, "cast": driving_cast})
    resumption.require_cast(plan, driving_cast)
    with pytest.raises(
        ConfigurationError, match="moves without a person in this trial, which is not permitted now"
    ) as caught:
        resumption.require_cast(plan, carried_cast)
    assert "--allow-motion" in caught.value.remedy
    # Permission to move does not matter if nothing moves the robot, or if a person does.
    resumption.require_cast(PLAN.model_copy(update={"cast": driving_cast}), carried_cast)
    resumption.require_cast(plan.model_copy(update={"cast": carried_cast}), driving_cast)


def test_a_trial_with_a_changed_program_is_not_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    program = tmp_path / "probe"
    program.write_bytes(b"1")
    text = "{name: p, summary: x, scenario: los, topology: master, protocols: [udp], repeats: 1, steps: [together: {"
    text += "during: [run: {robot: sender, put: probe, command: 'sh {put}'}, ping: {from: sender, to: receiver}]}]}"
    procedure = schema.validate(schema.parse(text, source="p.yaml"), Procedure)
    folder = tmp_path / "trial"
    folder.mkdir()
    plan = PLAN.model_copy(update={"procedure": procedure})
    (folder / "trial.yaml").write_text(schema.dump(plan), encoding="utf-8")
    monkeypatch.setattr(resumption, "code_hash", lambda: PLAN.code_sha256)
    assert [put.at for put in resumption.resumable(folder).program_copies()] == [".put/run/probe"]
    program.write_bytes(b"2")
    with pytest.raises(ConfigurationError, match="probe: the program has changed since the procedure was read"):
        resumption.resumable(folder)
