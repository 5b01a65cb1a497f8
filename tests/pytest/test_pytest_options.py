"""Options and configuration of the plugin, their errors, and tests that do not use it."""

import os
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.prompts import UNATTENDED
from fieldkit.pytest.evidence import LOG, EvidenceKeeper
from fieldkit.pytest.lab_fixture import OpenedLab
from fieldkit.pytest.plugin_options import Keep, LabOptions
from tests.helpers import suites
from tests.helpers.sshd import free_port, make_key

TEST_WITH_ROBOTS = "def test_uses_robots(robots):\n    pass\n"
PRINT_OPTIONS = """
def test_shows_options(lab_options, pytestconfig):
    from fieldkit.pytest import plugin_options
    values = lab_options, plugin_options.output(pytestconfig), plugin_options.keep(pytestconfig)
    print(*(f"[{value}]" for value in values), sep="\\n")
"""
LOADED_MODULES = """
import sys

def test_other():
    assert sorted(name for name in sys.modules if name.startswith(("fieldkit", "sim_backends"))) == [
        "fieldkit", "fieldkit.pytest", "fieldkit.pytest.plugin"
    ]
    assert not {"numpy", "pydantic", "yaml", "paramiko", "rich"} & set(sys.modules)

def test_own(lab, robots, trial):
    assert (lab, robots, trial) == (1, 2, 3)
"""
REPLACED_FIXTURES = """
import pytest

@pytest.fixture
def lab(): return 1

@pytest.fixture
def robots(): return 2

@pytest.fixture
def trial(): return 3
"""


MODULE_BACKEND = """
import pytest
from dataclasses import replace


@pytest.fixture(scope="module")
def lab_options(lab_options):
    return replace(lab_options, backend="mars")


"""
OPERATOR = """
import pytest
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.prompts import UNATTENDED
from fieldkit.pytest.lab_fixture import operator_of
from fieldkit.pytest.plugin_options import LabOptions


def test_operator(pytestconfig):
    person = operator_of(pytestconfig, LabOptions(), print)
    with pytest.raises(ConfigurationError, match="a person must carry it, but standard input") as caught:
        person.ask("carry it")
    assert "--fieldkit-yes" in caught.value.remedy
    assert operator_of(pytestconfig, LabOptions(yes=True), print) is UNATTENDED
"""


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """Run the tests of the current folder in this process, which has already imported fieldkit."""
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", *arguments)


def field_site(folder: Path) -> str:
    """Return a site file with two robots that are switched off."""
    host_key = " ".join(make_key(folder / "host_key").split()[:2])
    make_key(folder / "key")
    access = f"port: {free_port()}, user: pi, key: {folder / 'key'}, host_key: {host_key}"
    lines = [
        f"  {name}: {{profile: turtlebot3_burger, host: {host}, {access}}}"
        for name, host in (("robot-1", "127.0.0.1"), ("robot-2", "127.0.0.2"))
    ]
    roles = "roles: {masterless: {sender: robot-1, receiver: robot-2}}"
    return "\n".join(["backend: field", "patience: 1s", "robots:", *lines, roles, ""])


def test_tests_without_fixtures_of_the_plugin_import_no_other_module(tmp_path: Path) -> None:
    """Other fixtures with the same names are not affected."""
    suites.write(tmp_path, site="robots: [", test_modules=LOADED_MODULES, conftest=REPLACED_FIXTURES)
    result = suites.run(tmp_path)
    assert (result.code, set(result.results.values())) == (0, {"passed"}), result.output
    assert not (tmp_path / "fieldkit-results").exists()


def test_the_configuration_is_used_without_command_line_options(pytester: pytest.Pytester) -> None:
    pytester.makeini(
        "[pytest]\nfieldkit_site = ours.yaml\nfieldkit_topology = masterless\nfieldkit_output = out\n"
        "fieldkit_keep = all\nfieldkit_backend = emulated\n"
    )
    subfolder = pytester.mkdir("subfolder")
    suites.write(subfolder, site=None, test_shows_options=PRINT_OPTIONS)
    os.chdir(subfolder)
    output_text = run(pytester, "-s", "--fieldkit-backend", "field", "--fieldkit-output", "mine").stdout.str()
    assert f"site=PosixPath('{pytester.path}/ours.yaml')" in output_text
    assert "LabOptions(backend='field'" in output_text
    assert "topology='masterless'" in output_text
    assert f"[{subfolder}/mine]\n[all]" in output_text


@pytest.mark.parametrize(
    ("arguments", "message", "remedy"),
    [
        (("--fieldkit-backend", "emulatd"), "there is no backend 'emulatd'", "did you mean 'emulated'?"),
        (("--fieldkit-site", "gone.yaml"), "gone.yaml", "remedy: "),
        (("--fieldkit-topology", "master"), "the site file gives no roles for topology master", "add roles.master"),
    ],
)
def test_an_invalid_lab_is_an_error_of_set_up(
    pytester: pytest.Pytester, arguments: tuple[str, ...], message: str, remedy: str
) -> None:
    suites.write(pytester.path, test_uses_robots=TEST_WITH_ROBOTS)
    result = run(pytester, *arguments)
    assert (result.ret, result.parseoutcomes()) == (1, {"errors": 1})
    output_text = result.stdout.str()
    assert "ERROR at setup of test_uses_robots" in output_text
    assert message in output_text
    assert remedy in output_text
    assert "/fieldkit/" not in output_text, "no internals of fieldkit are shown"


def test_a_full_traceback_is_shown_on_request(pytester: pytest.Pytester) -> None:
    suites.write(pytester.path, test_uses_robots=TEST_WITH_ROBOTS)
    output_text = run(pytester, "--fieldkit-backend", "emulatd", "--tb=long").stdout.str()
    assert "fieldkit/backends/registry.py" in output_text


@pytest.mark.parametrize(
    "arguments", [("--fieldkit-keep", "som"), ("--fieldkit-topology", "mesh"), ("-o", "fieldkit_keep=som")]
)
def test_an_invalid_value_is_rejected_before_any_test(pytester: pytest.Pytester, arguments: tuple[str, ...]) -> None:
    suites.write(pytester.path, test_uses_robots=TEST_WITH_ROBOTS)
    result = run(pytester, *arguments)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert "choose from" in result.stderr.str()


def test_a_test_module_chooses_its_lab(pytester: pytest.Pytester) -> None:
    suites.write(pytester.path, test_uses_robots=MODULE_BACKEND + TEST_WITH_ROBOTS)
    assert "there is no backend 'mars'" in run(pytester).stdout.str()


def test_an_unreachable_robot_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    suites.write(tmp_path, site=field_site(tmp_path), test_uses_robots=TEST_WITH_ROBOTS)
    result = suites.run(tmp_path)
    assert (result.code, result.results) == (1, {"test_uses_robots": "error"}), result.output
    assert "robot-1: connection: 127.0.0.1 cannot be reached for SSH" in result.output
    assert "robot-2: connection: 127.0.0.2 cannot be reached for SSH" in result.output
    assert "start its SSH server" in result.output
    (_, folder) = result.properties["test_uses_robots"][0]
    assert "open field, masterless" in Path(folder, LOG).read_text(encoding="utf-8")


def test_error_without_a_terminal_names_the_option(pytester: pytest.Pytester) -> None:
    suites.write(pytester.path, test_operator=OPERATOR)
    run(pytester).assert_outcomes(passed=1)


def test_workers_do_not_share_real_robots(tmp_path: Path) -> None:
    site = tmp_path / "fieldkit.yaml"
    site.write_text(field_site(tmp_path), encoding="utf-8")
    keeper = EvidenceKeeper(tmp_path / "results" / "run", Keep.FAILED)
    lab = OpenedLab(LabOptions(site=site), keeper, UNATTENDED, workers=2)
    with pytest.raises(ConfigurationError, match="2 workers of pytest-xdist cannot share the robots") as error_info:
        lab.open()
    assert error_info.value.remedy.endswith("pytest -n 0")
