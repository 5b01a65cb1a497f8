"""The package `docs/examples/federates/fieldkit-jsbsim`: JSBSim as a physics federate."""

import sys
import tomllib
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import checks, run_check
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import PythonFederate, named_federate
from sim_backends.physics.body import Velocity
from sim_backends.world.world import load_world
from tests.helpers.federate_pairs import Pair
from tests.helpers.outside_packages import write_package
from tests.helpers.paths import ROOT

FOLDER = ROOT / "docs" / "examples" / "federates" / "fieldkit-jsbsim"
SCENARIO = FOLDER / "drones.yaml"
MAX_LINES = 99


@pytest.fixture(autouse=True)
def _package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the package: its metadata as pip writes it, and its folder in the path of this and other processes."""
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (entry,) = project["entry-points"][plugins.FEDERATES].items()
    write_package(tmp_path, project["name"], f"[{plugins.FEDERATES}]\n{' = '.join(entry)}\n", project["version"])
    for folder in (tmp_path, FOLDER):
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{FOLDER}:{ROOT}")
    monkeypatch.delitem(sys.modules, "fieldkit_jsbsim", raising=False)


def federate() -> PythonFederate:
    jsbsim = named_federate("jsbsim", PHYSICS)
    assert isinstance(jsbsim, PythonFederate)
    return jsbsim


def test_the_module_is_short() -> None:
    (module,) = FOLDER.glob("*.py")
    assert len(module.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


@pytest.mark.parametrize("name", checks(is_physics=True))
def test_the_jsbsim_federate_conforms(name: str) -> None:
    scenario = load_scenario(SCENARIO)
    world = load_world(scenario.world)
    hello = make_hello(scenario, world, make_bodies(scenario, world), 1, PHYSICS)
    result = run_check(Target(Pair(federate().load()), hello, windows=200), name, checks(is_physics=True)[name])
    assert not result.failure, result
    assert bool(result.skipped) == (name in {"fork", "drive_axes", "lifetimes", "turn"})


@pytest.mark.nightly
def test_the_conform_command_checks_the_jsbsim_federate_by_its_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["cosim", "conform", "jsbsim", "--scenario", str(SCENARIO)]) == 0, capsys.readouterr().out


def test_a_drone_follows_its_commands(capfd: pytest.CaptureFixture[str]) -> None:
    scenario = load_scenario(SCENARIO, {"duration": "3s"})
    with build(scenario, policy="sliding_window") as simulation:
        expected = simulation.run()
    with build(load_scenario(SCENARIO, {"duration": "3s", "physics.federate": "jsbsim"})) as simulation:
        run = simulation.run()
        states = simulation.agents.physics.advance(scenario.duration_ns, {"scout": Velocity((0.0, 2.0, 0.0))})
    assert len(run.fates) == len(expected.fates)
    assert states["guard"].position_m == pytest.approx((10.0, 10.0, 20.0), abs=0.3)
    assert capfd.readouterr().out == ""
    assert states["scout"].velocity_m_s == pytest.approx((0.0, 2.0, 0.0), abs=0.2)


def test_a_robot_that_drives_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="leader is a husky, which drives; JSBSim moves only drones"):
        build(load_scenario("convoy", {"physics.federate": "jsbsim"}))


def test_the_jsbsim_federate_has_no_options() -> None:
    with pytest.raises(ConfigurationError, match=r"in physics.options: unknown key wind; no keys are valid here"):
        load_scenario(SCENARIO, {"physics.federate": "jsbsim", "physics.options": {"wind": 1}})
