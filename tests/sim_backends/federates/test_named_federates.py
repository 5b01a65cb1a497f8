"""Simulators that the co-simulation uses by name, found by the entry points of their packages."""

from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.scenario.build import Simulation
from sim_backends.federates.frames import NETWORK, PHYSICS
from sim_backends.federates.named import command_line
from sim_backends.federates.remote import RemotePhysics
from tests.helpers.outside_packages import write_package
from tests.helpers.paths import ROOT

CARTS = (ROOT / "docs" / "examples" / "federates" / "carts.py").read_text(encoding="utf-8")
MODULE = """
import shlex
import sys
from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.answering import FederateService
from sim_backends.federates.frames import NETWORK, PHYSICS
from sim_backends.federates.named import ProgramFederate, PythonFederate

def load():
    from carts_example import Carts
    return FederateService(Carts, name="carts", software="carts 1.0", forks=False)

def missing():
    raise ConfigurationError("airwaves needs libair", remedy="apt-get install libair")

CARTS = PythonFederate(PHYSICS, load)
SERVED = shlex.join((sys.executable, "-m", "sim_backends.cosim.scenario.served", "physics"))
PROGRAM = ProgramFederate(PHYSICS, lambda: SERVED)
AIRWAVES = ProgramFederate(NETWORK, missing)
"""


@pytest.fixture(autouse=True)
def _package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = "carts = carts_kinds:CARTS\nserved = carts_kinds:PROGRAM\nairwaves = carts_kinds:AIRWAVES\n"
    write_package(tmp_path, "fieldkit-carts", f"[{plugins.FEDERATES}]\n{entries}wrong = carts_kinds:load\n")
    (tmp_path / "carts_kinds.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "carts_example.py").write_text(CARTS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")


def convoy(**changes: str) -> Simulation:
    values = {key.replace("_", "."): value for key, value in changes.items()}
    return build(load_scenario("convoy", {"duration": "100ms", **values}), policy="sliding_window")


def test_a_python_class_runs_in_this_process_and_a_program_in_another(tmp_path: Path) -> None:
    with convoy(physics_federate="carts") as simulation:
        assert type(simulation.agents.physics).__name__ == "Carts"
        assert simulation.run().windows_ns
    with convoy(physics_federate="served") as simulation:
        assert isinstance(simulation.agents.physics, RemotePhysics)
        assert simulation.run().windows_ns


def test_the_name_builtin_means_the_built_in_federates() -> None:
    scenario = load_scenario("convoy", {"physics.federate": "builtin", "network.federate": "builtin"})
    assert (scenario.physics.federate, scenario.network.federate) == (None, None)


@pytest.mark.parametrize(
    ("role", "name", "message", "remedy"),
    [
        (NETWORK, "airwaves", "airwaves needs libair", "apt-get install libair"),
        (PHYSICS, "airwaves", "airwaves is a network federate, not a physics federate", "use --network airwaves"),
        (
            PHYSICS,
            "cart",
            "there is no physics federate and no program with the name 'cart'",
            "did you mean 'carts'?",
        ),
        (PHYSICS, "wrong", "it is not a ProgramFederate or PythonFederate", plugins.REMEDY),
    ],
)
def test_a_federate_that_cannot_be_used_is_refused_with_a_remedy(
    role: int, name: str, message: str, remedy: str
) -> None:
    with pytest.raises(ConfigurationError, match=message) as error_info:
        command_line(name, role)
    assert error_info.value.remedy == remedy


def test_the_conformance_suite_checks_a_federate_by_its_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code = main(["cosim", "conform", "carts", "--role", "physics", "--windows", "1000"])
    output = capsys.readouterr()
    assert code == 0, output.out
    assert "physics carts (carts)" in output.err
