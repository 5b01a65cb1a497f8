"""Packages import each other in one direction, and each dependency is imported by few modules."""

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
from fieldkit.steps.capabilities import CAPABILITIES
from tests.helpers.paths import ROOT

# A package may import itself, `core`, and the packages listed here.
MAY_IMPORT = {
    "core": set(),
    "config": set(),
    "remote": set(),
    "measure": set(),
    "analysis": set(),
    "backends": {"config", "remote"},
    "lab": {"backends", "config"},
    "agent": set(),  # it runs on robots without `core`: see tests/agent
    "steps": {"agent", "backends", "config", "measure", "remote"},
    "telemetry": {"backends", "config", "measure", "remote", "steps"},
    "trial": {"analysis", "backends", "config", "measure", "remote", "steps", "telemetry"},
    "campaign": {"analysis", "backends", "config", "trial"},
    "report": {"analysis", "lab", "measure", "telemetry", "trial"},
    "export": {"analysis", "measure", "telemetry", "trial"},
    "api": {"analysis", "export", "measure", "report", "trial"},
    "cli": {
        "agent",
        "analysis",
        "backends",
        "campaign",
        "config",
        "export",
        "lab",
        "remote",
        "report",
        "steps",
        "telemetry",
        "trial",
    },
    # The following packages are loaded through entry points.
    "ros": {
        "agent",
        "analysis",
        "backends",
        "cli",
        "config",
        "measure",
        "remote",
        "report",
        "steps",
        "trial",
    },
    "motion": {
        "agent",
        "backends",
        "cli",
        "config",
        "lab",
        "measure",
        "remote",
        "ros",
        "steps",
        "trial",
    },
    "pytest": {"analysis", "api", "backends", "cli", "measure", "remote", "trial"},
}
# Measurement and analysis must not depend on how the files of a lab are read.
LEAVES = {
    package_name: {
        "core.model",
        "core.plugins",
        "core.units",
        "core.errors",
        "core.columns",
        "core.result_rows",
        "core.text",
        "core.crosschecks",
        "core.laptop_files",
    }
    for package_name in ("analysis", "measure")
}

PARENTS = {"fieldkit.core"}
"""The first name imported by `from fieldkit.core import units`."""

MAX_MODULES = 28
"""Maximum number of modules in a package, so that a module can be found by reading the names."""
WALK = ROOT / "docs" / "walk.md"
"""The introduction for new contributors."""

OTHER_TEST_FOLDERS = {"benchmarks", "data", "e2e", "fuzz", "helpers"}
"""Folders of tests that belong to no shipped package: benchmarks, real outputs, end-to-end tests, fuzzing and
helpers.
"""

ONE_IMPORTER = {
    "yaml": "fieldkit/config/documents.py",
    "pydantic": "fieldkit/config/schema.py",
    "pydantic_core": "fieldkit/config/schema.py",
    # There is one module per format: CSV is read into columns, and columns are written as Parquet or into an index.
    # Simulators must not import these modules, so they write their tables with other modules.
    "pyarrow": "fieldkit/analysis/parsing.py fieldkit/analysis/datasets.py fieldkit/analysis/table_index.py "
    "fieldkit/export/table.py "
    "sim_backends/cosim/recording/packet_tables.py sim_backends/cosim/sweeps/sweep_dataset.py",
    "distributed": "fieldkit/core/cluster.py",
    # These modules recover truncated bags, and write the messages of trials and of co-simulation recordings.
    "mcap": "fieldkit/ros/bags/salvage.py fieldkit/export/mcap.py sim_backends/cosim/recording/mcap.py",
    # Trials and simulations draw different figures; `report.theme` defines their style.
    "matplotlib": "fieldkit/report/drawing.py fieldkit/report/figures.py sim_backends/cosim/plots.py",
    "jinja2": "fieldkit/report/page.py",
    "gpxpy": "fieldkit/measure/positions/gpx_reader.py",
    "jmespath": "fieldkit/measure/evidence/program_output.py",
    "re2": "fieldkit/measure/evidence/program_output.py",
    # These modules contain connections and key formats.
    "paramiko": "fieldkit/remote/keys.py fieldkit/remote/link.py",
    "keyring": "fieldkit/remote/passwords.py",
    # These modules display text on a terminal.
    "rich": "fieldkit/cli/display.py fieldkit/cli/event_words.py",
    "argcomplete": "fieldkit/cli/commands/completion.py",
    # These modules read a drone's log in a separate process, and write the messages of an emulated drone.
    "pymavlink": "fieldkit/motion/logs/tlog_reader.py sim_backends/emulated/autopilot/mavlink_frames.py",
    "lz4": "fieldkit/ros/bags/salvage.py",
    "cyclonedds": "fieldkit/agent/messaging/dds.py",
    "zenoh": "fieldkit/agent/messaging/zenoh.py",
    # One module runs on a robot, and the other relays the sensors of an emulated robot to its master.
    "rospy": "fieldkit/agent/messaging/ros1.py sim_backends/emulated/robot/ros_relay.py",
    "rclpy": "fieldkit/agent/messaging/ros2.py",
    "cryptography": "sim_backends/emulated/provisioning.py",
    "mujoco": "sim_backends/mujoco_physics/physics.py",
}


PROVIDED: Final = {"pytest", "rclpy", "rosgraph", "roslib", "rospy"}
"""Modules that the environment provides: pytest runs the plugin, and ROS is installed on the robot."""
PACKAGE_PARTS: Final = {"pydantic_core": "pydantic", "pandas": "pandas"}
"""Modules that belong to the package that pins their version; only pyarrow uses pandas, and only on request."""


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@cache
def imported_names(path: Path) -> tuple[str, ...]:
    return tuple(_iter_imported_names(path))


def _iter_imported_names(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield f"{node.module}"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def package_name(dotted_names: str) -> str:
    parts = dotted_names.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("own_package", sorted({path.relative_to(ROOT).parts[1] for path in modules("fieldkit")}))
def test_imports_point_in_one_direction(own_package: str) -> None:
    paths = [path for path in modules("fieldkit") if path.relative_to(ROOT).parts[1] == own_package]
    for path, name in ((module, name) for module in paths for name in imported_names(module)):
        assert not name.startswith("sim_backends"), f"{path} imports {name}"
        target = package_name(name)
        if not name.startswith("fieldkit.") or target in {own_package, "__version__"}:
            continue
        if own_package in LEAVES:
            assert name.removeprefix("fieldkit.").startswith(tuple(LEAVES[own_package])) or name in PARENTS, (
                f"{path} imports {name}"
            )
        elif own_package in MAY_IMPORT:
            assert target in {"core"} | MAY_IMPORT[own_package], f"{path} imports {name}"
        else:
            assert own_package in {"__init__.py", "__main__.py"}, f"{path} is in no package"


@pytest.mark.parametrize(
    ("package", "importers"),
    [("fieldkit.motion", ()), ("fieldkit.ros", ("fieldkit/motion", "sim_backends"))],
    ids=["motion", "ros"],
)
def test_only_entry_points_lead_to_a_product(package: str, importers: tuple[str, ...]) -> None:
    """`tests/e2e/test_borders.py` removes these packages and runs tests of the harness.

    `fieldkit.motion` sends messages of ROS to drive robots, and emulated robots publish messages of ROS.
    """
    importing_paths = (package.replace(".", "/"), *importers)
    for path in modules("fieldkit") + modules("sim_backends"):
        if not str(path.relative_to(ROOT)).startswith(importing_paths):
            names = imported_names(path)
            assert not any(name == package or name.startswith(f"{package}.") for name in names), path


ROS_SEAMS = ("fieldkit.ros.interfaces", "fieldkit.ros.middlewares.ports")
"""The modules of `fieldkit.ros` that `sim_backends` imports: message types, names, quality of service, ports."""

NAMES_OF_MOTION: Final = re.compile(r"""["'.](mavlink|drives?|flies)\b(?!\.|_)|on_abort|allow.motion""")
NAMING_MOTION: Final = {
    "core/plugins.py": "the package of each section, for an error message without it",
    "backends/protocols.py": "keys in plans of earlier versions",
    "trial/request.py": "hashes equal to those of earlier versions",
}


def test_the_harness_does_not_name_keys_and_permissions_of_motion() -> None:
    """These are sections of profiles and procedures, and permissions."""
    harness = [path.relative_to(ROOT / "fieldkit") for path in modules("fieldkit")]
    naming_modules = {
        str(path)
        for path in harness
        if path.parts[0] not in {"motion", "agent"}
        and NAMES_OF_MOTION.search((ROOT / "fieldkit" / path).read_text(encoding="utf-8"))
    }
    assert naming_modules == NAMING_MOTION.keys()


# Commands of other packages may use these modules to declare arguments, to display and to draw like fieldkit's
# commands
# (docs/add-a-command.md), and to measure a simulated trial like a trial with robots.
COMMAND_SEAMS = (
    "fieldkit.trial.simulated",
    "fieldkit.cli.shared_arguments",
    "fieldkit.cli.display",
    "fieldkit.cli.parser",
    "fieldkit.report.theme",
)
COMMANDS = ("sim_backends/cosim/commands/", "sim_backends/cosim/plots.py")


def test_backends_import_only_the_seams() -> None:
    for path, name in ((module, name) for module in modules("sim_backends") for name in imported_names(module)):
        seams = COMMAND_SEAMS if str(path.relative_to(ROOT)).startswith(COMMANDS) else ()
        if name.startswith("fieldkit."):
            assert package_name(name) in {"core", "config", "backends", "remote", "agent"} or name.startswith(
                (
                    "fieldkit.lab.folder",
                    "fieldkit.lab.protocol",
                    "fieldkit.lab.requests",
                    "fieldkit.lab.robots",
                    *ROS_SEAMS,
                    *seams,
                )
            ), f"{path} imports {name}"


@pytest.mark.parametrize(("package", "importer"), ONE_IMPORTER.items())
def test_one_dependency_has_one_importing_module(package: str, importer: str) -> None:
    importers = {
        str(path.relative_to(ROOT))
        for path in modules("fieldkit") + modules("sim_backends")
        if any(name.split(".")[0] == package for name in imported_names(path))
    }
    assert importers == set(importer.split())


def test_required_and_imported_packages_are_the_same() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    required = {
        re.split(r"[<>=]", line)[0]
        for line in (
            *project["dependencies"],
            *extras["cluster"],
            *extras["mujoco"],
            *extras["pandas"],
            *extras["ros2"],
        )
    }
    paths = modules("fieldkit") + modules("sim_backends")
    top_level_names = {name.split(".")[0] for path in paths for name in imported_names(path)}
    external_names = (
        (top_level_names | PACKAGE_PARTS.keys()) - sys.stdlib_module_names - PROVIDED - {"fieldkit", "sim_backends"}
    )
    owners = packages_distributions()
    owner_names = {
        owner.lower()
        for name in external_names
        for owner in ([PACKAGE_PARTS[name]] if name in PACKAGE_PARTS else owners[name])
    }
    assert owner_names == {name.lower() for name in required}


def test_the_library_does_not_mention_emulated() -> None:
    """Steps, trial and remote run unchanged on every backend, so they must not depend on the kind of backend."""
    for folder in ("steps", "trial", "remote", "measure", "analysis"):
        for path in modules(f"fieldkit/{folder}"):
            text = path.read_text(encoding="utf-8").replace(
                "emulated.late_bound", ""
            )  # a key in the description of a column
            assert "emulated" not in text, path


def subpackages(package: str) -> list[Path]:
    """Return the folders with modules below a package."""
    return sorted({path.parent for path in modules(package)} - {ROOT / package})


def imports_between(folder: Path) -> dict[str, set[str]]:
    """Return, for each package in a folder, the other packages of the folder that its modules import.

    Modules directly in the folder count as a package with the folder's name.
    """
    subpackage_names = {entry.name for entry in folder.iterdir() if (entry / "__init__.py").exists()}
    package_of = {path.stem: folder.name for path in folder.glob("*.py")} | {name: name for name in subpackage_names}
    prefix = ".".join(folder.relative_to(ROOT).parts) + "."
    imports: dict[str, set[str]] = {name: set() for name in package_of.values()}
    for path in modules(str(folder.relative_to(ROOT))):
        own_package = package_of[path.relative_to(folder).with_suffix("").parts[0]]
        targets = {
            name.removeprefix(prefix).split(".")[0] for name in imported_names(path) if name.startswith(prefix)
        }
        imports[own_package] |= {package_of[target] for target in targets if target in package_of} - {own_package}
    return imports


@pytest.mark.parametrize(
    "folder",
    [
        "fieldkit",
        "fieldkit/measure",
        "fieldkit/ros",
        "fieldkit/trial",
        "sim_backends",
        "sim_backends/emulated",
        "sim_backends/radio",
    ],
)
def test_packages_have_no_import_cycles(folder: str) -> None:
    graph = imports_between(ROOT / folder)
    assert len(graph) > 2
    assert set(TopologicalSorter(graph).static_order()) == graph.keys(), (
        "static_order raises CycleError, which names the packages"
    )


def test_a_package_has_a_limited_number_of_modules() -> None:
    for folder in subpackages("fieldkit") + subpackages("sim_backends"):
        names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
        if folder.name == "steps":
            names -= kinds.builtin_names()  # the module of a kind has the kind's name in procedures
        assert len(names) <= MAX_MODULES, folder


def test_tests_mirror_the_tree() -> None:
    folders = {path.parent.relative_to(ROOT / "tests") for path in modules("tests")} - {Path()}
    package_tests = {folder for folder in folders if folder.parts[0] not in OTHER_TEST_FOLDERS}
    package_folders = {folder.relative_to(ROOT / "fieldkit") for folder in subpackages("fieldkit")}
    package_folders |= {folder.relative_to(ROOT) for folder in subpackages("sim_backends")}
    assert package_tests <= package_folders, "tests of packages that do not exist"


def test_no_test_is_in_the_root() -> None:
    assert {path.name for path in (ROOT / "tests").glob("*.py")} == {"conftest.py", "test_architecture.py"}


def code_spans(text: str) -> list[str]:
    """Return the code spans (text in backticks) of a Markdown text."""
    return re.findall(r"`([^`\n]+)`", text)


def test_names_in_the_walk_exist() -> None:
    dotted_names = [
        name for name in code_spans(WALK.read_text(encoding="utf-8")) if re.fullmatch(r"[a-z_]+(\.\w+)+", name)
    ]
    for name in (name for name in dotted_names if not name.endswith((".csv", ".yaml"))):
        pkgutil.resolve_name(f"fieldkit.{name}")


@pytest.mark.parametrize("page", [WALK, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_files_named_in_contributor_pages_exist(page: Path) -> None:
    paths = [
        name
        for name in code_spans(page.read_text(encoding="utf-8"))
        if re.fullmatch(r"\w+/[\w./]*\w(/|\.\w+)?", name)
    ]
    assert len(paths) > 10
    for path in paths:
        assert any((ROOT / start / path).exists() for start in ("", "fieldkit")), path


def test_the_walk_names_each_method_of_a_step() -> None:
    methods = {name for cls in (Step, *CAPABILITIES) for name, member in vars(cls).items() if isfunction(member)}
    rows = WALK.read_text(encoding="utf-8").split("| caller | method |")[1]
    assert {name for name in code_spans(rows) if name.isidentifier()} == {
        name for name in methods - {"prefixed_name"} if not name.startswith("_")
    }


# Only these modules of the co-simulation use external federates.
FEDERATE_SEAMS = {
    "sim_backends/cosim/federates.py": {"protocols"},
    "sim_backends/cosim/scenario/external.py": {
        "frames",
        "handshake",
        "ip_radio",
        "named",
        "protocols",
        "remote",
        "simulator_options",
        "transports",
    },
    "sim_backends/cosim/scenario/build.py": {"ip_radio"},
    "sim_backends/cosim/scenario/federate_choice.py": {"frames", "named", "simulator_options"},
    "sim_backends/cosim/scenario/served.py": {"frames", "handshake", "serving"},
    "sim_backends/cosim/commands/conform.py": {"conformance", "frames", "handshake", "named", "protocols", "session"},
}


def test_the_co_simulation_has_one_seam_to_external_federates() -> None:
    prefix = "sim_backends.federates."
    for path in modules("sim_backends/cosim"):
        targets = {
            name.removeprefix(prefix).split(".")[0] for name in imported_names(path) if name.startswith(prefix)
        }
        allowed = FEDERATE_SEAMS.get(str(path.relative_to(ROOT)), set())
        assert targets <= allowed, f"{path} imports {targets - allowed}"


def test_class_names_are_unique() -> None:
    """Each class name is unique, also of private classes, so that a search finds one class."""
    places_by_name: dict[str, list[str]] = {}
    for path in modules("fieldkit") + modules("sim_backends"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places_by_name.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: places for name, places in places_by_name.items() if len(places) > 1} == {}
