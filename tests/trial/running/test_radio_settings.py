"""Settings of radios at the start of a trial, from real outputs that a fake `iw` prints."""

from pathlib import Path

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.core.model import Role
from fieldkit.remote.shell import Shell
from fieldkit.trial.running import radio_settings
from tests.helpers.casts import los_plan
from tests.helpers.paths import DATA
from tests.helpers.userlands import LocalShell

PLAN = los_plan()
AT_START = {"channel": "6 (2437 MHz), width 20 MHz", "regulatory_domain": "HR"}


def robot_shell(folder: Path, info: str, domain: str = "reg-ath10k-ct") -> Shell:
    """Return the shell of a robot with an `iw` that prints these two stored outputs."""
    folder.mkdir(exist_ok=True)
    program = folder / "iw"
    program.write_text(
        f'#!/bin/sh\ncase "$*" in "dev wlan0 info") exec cat "{DATA}/iw/{info}.txt" ;; '
        f'"reg get") exec cat "{DATA}/iw/{domain}.txt" ;; *) exit 1 ;; esac\n',
        encoding="utf-8",
    )
    program.chmod(0o755)
    return LocalShell(folder, path=f"{folder}:/usr/bin:/bin")


def test_settings_are_read_from_each_robot_that_has_iw(tmp_path: Path) -> None:
    shells = {
        Role.SENDER: robot_shell(tmp_path / "sender", "info-hwsim-station-6"),
        Role.RECEIVER: LocalShell(tmp_path, path="/usr/bin:/bin"),
        Role.RELAY: robot_shell(tmp_path / "relay", "no-wifi"),
    }
    assert radio_settings.read(PLAN, shells) == {
        Role.SENDER: AT_START,
        Role.RELAY: {"regulatory_domain": "HR"},
    }


def test_a_trial_is_not_resumed_on_another_channel(tmp_path: Path) -> None:
    shells = {Role.SENDER: robot_shell(tmp_path / "sender", "info-hwsim-station-6")}
    plan = PLAN.model_copy(update={"radios": {Role.SENDER: AT_START}})
    radio_settings.require_unchanged(plan, shells)
    robot_shell(tmp_path / "sender", "info-ap")
    with pytest.raises(RobotError, match=r"channel 1 \(2412 MHz\), width 20 MHz, but 6 \(2437 MHz\), width 20 MHz"):
        radio_settings.require_unchanged(plan, shells)
    robot_shell(tmp_path / "sender", "info-hwsim-down-5")
    radio_settings.require_unchanged(plan, shells)  # an unknown channel is not another channel
    robot_shell(tmp_path / "sender", "info-hwsim-station-6", "reg-balena")
    with pytest.raises(RobotError, match="regulatory domain 00, but HR at the start"):
        radio_settings.require_unchanged(plan, shells)
