"""The imports point one way, and one dependency has one importing module (design, section 2; style, rule 11)."""

import ast
import pkgutil
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from inspect import isfunction
from pathlib import Path
from typing import Final

import pytest

from fieldkit.steps import kinds
from fieldkit.steps.base import Step
from tests.helpers.paths import ROOT

# A room may import itself, `core`, and what is named here: nobody imports to the left of it.
MAY_IMPORT = {
    "core": set(),
    "config": set(),
    "remote": set(),
    "measure": set(),
    "analysis": set(),
    "backends": {"config", "remote"},
    "lab": {"backends", "config"},
    "ros": {"agent"},  # the bridge
    "agent": set(),  # it runs on robots, and has not even `core` there: see tests/agent
    "steps": {"agent", "backends", "config", "measure", "remote", "ros"},
    "trial": {"analysis", "backends", "config", "measure", "remote", "steps"},
    "campaign": {"backends", "config", "trial"},
    "report": {"analysis", "lab", "measure", "trial"},
    "export": {"analysis", "measure", "trial"},
    "api": {"analysis", "export", "measure", "report", "trial"},
    "bags": {"measure"},
    "cli": {
        "agent",
        "analysis",
        "backends",
        "bags",
        "campaign",
        "config",
        "export",
        "lab",
        "remote",
        "report",
        "ros",
        "steps",
        "trial",
    },
    "pytest": {"analysis", "api", "backends", "cli", "measure", "remote", "trial"},
}
# Measuring and computing must not even know how a file of a lab is read.
LEAVES = {
    room: {
        "core.model",
        "core.units",
        "core.errors",
        "core.columns",
        "core.text",
        "core.crosschecks",
        "core.laptop_files",
    }
    for room in ("analysis", "measure")
}

PARENTS = {"fieldkit.core"}
"""What `from fieldkit.core import units` names first."""

MOST_MODULES = 28
"""In one room: with more, nobody finds a module by reading the names."""
WALK = ROOT / "docs" / "walk.md"
"""The first page for who is new."""

TESTS_APART = {"benchmarks", "data", "e2e", "fuzz", "helpers"}
"""Folders of tests of no shipped package: benchmarks, real outputs, whole runs, hostile inputs, shared helpers."""

ONE_IMPORTER = {
    "yaml": "fieldkit/config/documents.py",
    "pydantic": "fieldkit/config/schema.py",
    "pydantic_core": "fieldkit/config/schema.py",
    # Two formats, one of each: CSV is read into columns, columns are written as Parquet. Simulators, which
    # may import neither, record tables of their own.
    "pyarrow": "fieldkit/analysis/parsing.py fieldkit/export/table.py sim_backends/cosim/recording/tables.py",
    # Trials' messages, those of recordings of the co-simulation, and what is left of bags that are cut off.
    "mcap": "fieldkit/bags/salvage.py fieldkit/export/mcap.py sim_backends/cosim/recording/mcap.py",
    # Trials and simulations draw different things; what they look like is `report.theme`'s.
    "matplotlib": "fieldkit/report/drawing.py fieldkit/report/figures.py sim_backends/cosim/plots.py",
    "jinja2": "fieldkit/report/page.py",
    "gpxpy": "fieldkit/measure/positions/gpx_reader.py",
    "jmespath": "fieldkit/measure/evidence/program_output.py",
    "re2": "fieldkit/measure/evidence/program_output.py",
    # Connections, and the formats of keys.
    "paramiko": "fieldkit/remote/keys.py fieldkit/remote/link.py",
    "keyring": "fieldkit/remote/passwords.py",
    "rich": "fieldkit/cli/display.py",
    "argcomplete": "fieldkit/cli/commands/completion.py",
    # What the drone says, and, in a process of its own, what a log of it holds.
    "pymavlink": "fieldkit/measure/motion/tlog_reader.py sim_backends/emulated/autopilot/mavlink.py",
    "lz4": "fieldkit/bags/salvage.py",
    "cyclonedds": "fieldkit/agent/dds.py",
    "zenoh": "fieldkit/agent/zenoh.py",
    # On a robot, and what relays an emulated one's sensors to its master.
    "rospy": "fieldkit/agent/ros1.py sim_backends/emulated/robot/ros_relay.py",
    "rclpy": "fieldkit/agent/ros2.py",
    "cryptography": "sim_backends/emulated/provisioning.py",
}


BROUGHT: Final = {"pytest", "rclpy", "rosgraph", "roslib", "rospy"}
"""What is there wherever it is imported: pytest runs the plugin, ROS is the robot's."""
PARTS: Final = {"pydantic_core": "pydantic", "pandas": "pandas"}
"""A part of another package, which names its version; what pyarrow makes of columns for who asks for it."""


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@cache
def imported(path: Path) -> tuple[str, ...]:
    return tuple(_imported(path))


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield f"{node.module}"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(dotted: str) -> str:
    parts = dotted.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("path", modules("fieldkit"), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_one_way(path: Path) -> None:
    own = path.relative_to(ROOT / "fieldkit").parts[0]
    for name in imported(path):
        assert not name.startswith("sim_backends"), f"{path} imports {name}"
        target = room(name)
        if not name.startswith("fieldkit.") or target in {own, "__version__"}:
            continue
        if own in LEAVES:
            assert name.removeprefix("fieldkit.").startswith(tuple(LEAVES[own])) or name in PARENTS, (
                f"{path} imports {name}"
            )
        elif own in MAY_IMPORT:
            assert target in {"core"} | MAY_IMPORT[own], f"{path} imports {name}"
        else:
            assert own in {"__init__.py", "__main__.py"}, f"{path} is in no room"


# A command that a package adds declares, shows and draws as fieldkit's own do (docs/add-a-command.md).
COMMAND_SEAMS = (
    "fieldkit.cli.shared_arguments",
    "fieldkit.cli.display",
    "fieldkit.cli.parser",
    "fieldkit.report.theme",
)
COMMANDS = ("sim_backends/cosim/commands/", "sim_backends/cosim/plots.py")


@pytest.mark.parametrize("path", modules("sim_backends"), ids=lambda path: str(path.relative_to(ROOT)))
def test_backends_import_only_the_seams(path: Path) -> None:
    seams = COMMAND_SEAMS if str(path.relative_to(ROOT)).startswith(COMMANDS) else ()
    for name in imported(path):
        if name.startswith("fieldkit."):
            assert room(name) in {"core", "config", "backends", "remote", "ros", "agent"} or name.startswith(
                ("fieldkit.lab.protocol", *seams)
            ), f"{path} imports {name}"


@pytest.mark.parametrize(("package", "importer"), ONE_IMPORTER.items())
def test_one_dependency_has_one_importing_module(package: str, importer: str) -> None:
    importers = {
        str(path.relative_to(ROOT))
        for path in modules("fieldkit") + modules("sim_backends")
        if any(name.split(".")[0] == package for name in imported(path))
    }
    assert importers == set(importer.split())


def test_what_is_imported_is_required_and_what_is_required_is_imported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    required = {
        re.split(r"[<>=]", line)[0] for line in (*project["dependencies"], *extras["pandas"], *extras["ros2"])
    }
    paths = modules("fieldkit") + modules("sim_backends")
    tops = {name.split(".")[0] for path in paths for name in imported(path)}
    outside = (tops | PARTS.keys()) - sys.stdlib_module_names - BROUGHT - {"fieldkit", "sim_backends"}
    owners = packages_distributions()
    owned = {owner.lower() for top in outside for owner in ([PARTS[top]] if top in PARTS else owners[top])}
    assert owned == {name.lower() for name in required}


def test_no_sentence_in_the_library_says_emulated() -> None:
    """Steps, trial and remote run unchanged on every backend, so none of them may ask which one it is."""
    for folder in ("steps", "trial", "remote", "measure", "analysis"):
        for path in modules(f"fieldkit/{folder}"):
            text = path.read_text(encoding="utf-8").replace("emulated.late_bound", "")  # a key, named in a meaning
            assert "emulated" not in text, path


def rooms(package: str) -> list[Path]:
    """Return the folders of a package that have modules, the package itself left out."""
    return sorted({path.parent for path in modules(package)} - {ROOT / package})


def needs(folder: Path) -> dict[str, set[str]]:
    """Return for each room in a folder the others there that its modules import.

    The modules beside the rooms are a room of their own, named as the folder.
    """
    inside = {room.name for room in folder.iterdir() if (room / "__init__.py").exists()}
    room_of = {path.stem: folder.name for path in folder.glob("*.py")} | {name: name for name in inside}
    prefix = ".".join(folder.relative_to(ROOT).parts) + "."
    found: dict[str, set[str]] = {name: set() for name in room_of.values()}
    for path in modules(str(folder.relative_to(ROOT))):
        own = room_of[path.relative_to(folder).with_suffix("").parts[0]]
        targets = {name.removeprefix(prefix).split(".")[0] for name in imported(path) if name.startswith(prefix)}
        found[own] |= {room_of[target] for target in targets if target in room_of} - {own}
    return found


@pytest.mark.parametrize(
    "folder", ["fieldkit", "fieldkit/measure", "fieldkit/trial", "sim_backends", "sim_backends/emulated"]
)
def test_no_room_is_needed_by_the_one_it_needs(folder: str) -> None:
    graph = needs(ROOT / folder)
    assert len(graph) > 2
    assert set(TopologicalSorter(graph).static_order()) == graph.keys(), "raises CycleError, which names the rooms"


@pytest.mark.parametrize(
    "folder", rooms("fieldkit") + rooms("sim_backends"), ids=lambda path: str(path.relative_to(ROOT))
)
def test_a_room_is_not_crowded(folder: Path) -> None:
    names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    if folder.name == "steps":
        names -= kinds.builtin()  # the module of a kind is found by the name that procedures give
    assert len(names) <= MOST_MODULES


def test_tests_mirror_the_tree() -> None:
    kept = {path.parent.relative_to(ROOT / "tests") for path in modules("tests")} - {Path()}
    about = {folder for folder in kept if folder.parts[0] not in TESTS_APART}
    mirrored = {room.relative_to(ROOT / "fieldkit") for room in rooms("fieldkit")}
    mirrored |= {room.relative_to(ROOT) for room in rooms("sim_backends")}
    assert about <= mirrored, "tests of rooms that are not there"


def test_no_test_stands_in_the_root() -> None:
    assert {path.name for path in (ROOT / "tests").glob("*.py")} == {"conftest.py", "test_architecture.py"}


def in_quotes(text: str) -> list[str]:
    """Return what stands in backticks in a text of Markdown."""
    return re.findall(r"`([^`\n]+)`", text)


def test_the_walk_leads_by_stations_that_are_there() -> None:
    stations = WALK.read_text(encoding="utf-8").split("What is asked of a kind of step")[0]
    dotted = [name for name in in_quotes(stations) if re.fullmatch(r"[a-z_]+(\.\w+)+", name)]
    for name in (name for name in dotted if not name.endswith((".csv", ".yaml"))):
        pkgutil.resolve_name(f"fieldkit.{name}")


@pytest.mark.parametrize("page", [WALK, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_pages_for_contributors_name_files_that_are_there(page: Path) -> None:
    paths = [
        name for name in in_quotes(page.read_text(encoding="utf-8")) if re.fullmatch(r"\w+/[\w./]*\w(/|\.\w+)?", name)
    ]
    assert len(paths) > 10
    for path in paths:
        assert any((ROOT / start / path).exists() for start in ("", "fieldkit")), path


def test_the_walk_names_each_question_that_a_step_is_asked() -> None:
    asked = {name for name, what in vars(Step).items() if isfunction(what)} - {"own_name", "kind_name"}
    rows = WALK.read_text(encoding="utf-8").split("| asked by | question |")[1]
    assert {name for name in in_quotes(rows) if name.isidentifier()} == {
        name for name in asked if not name.startswith("_")
    }


def test_a_class_has_its_name_alone() -> None:
    """Whoever reads or searches a name finds one class: of private ones, too, since none stands twice."""
    found: dict[str, list[str]] = {}
    for path in modules("fieldkit") + modules("sim_backends"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: places for name, places in found.items() if len(places) > 1} == {}
