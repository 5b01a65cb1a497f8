"""Run commands of one exported tree, and store their output and the files that they write.

Runs as a program in an environment in which Python imports that tree: `python -P recorder.py ITEMS RESULTS`, where
ITEMS is a JSON file with a list of items (`items.Item` as dictionaries), and RESULTS is a folder, which is created.
With `--commands` it prints the commands of the tree. It imports only the standard library and public names of the
tree: the module `fieldkit`, and `build` and `load_scenario` of `sim_backends.cosim`.

All commands run in this process in sequence, because importing the libraries takes longer than most commands.
"""

import contextlib
import io
import json
import os
import re
import runpy
import shutil
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def record(item: dict[str, Any], folder: Path) -> None:
    """Run an item; write `exit_code`, `stdout`, `stderr` and its outputs into `folder`.

    Outputs that the item creates are moved, so that it can run again; outputs that it changes are copied.
    """
    folder.mkdir(parents=True)
    os.chdir(item["working_folder"])
    new_outputs = [name for name in item["outputs"] if not Path(name).exists()]
    saved = os.dup(1), os.dup(2)
    with (folder / "stdout").open("wb") as out, (folder / "stderr").open("wb") as error:
        os.dup2(out.fileno(), 1)
        os.dup2(error.fileno(), 2)
        sys.stdout, sys.stderr = _stream(1), _stream(2)
        try:
            code = _run(item)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os.dup2(saved[0], 1)
            os.dup2(saved[1], 2)
            sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
            os.close(saved[0])
            os.close(saved[1])
    (folder / "exit_code").write_text(f"{code}\n", encoding="ascii")
    os.chdir(item["working_folder"])
    for name in new_outputs:
        if Path(name).exists():
            shutil.move(name, folder / name.replace("/", "+"))
    for name in set(item["outputs"]) - set(new_outputs):
        shutil.copy(name, folder / name.replace("/", "+"))


def _stream(descriptor: int) -> io.TextIOWrapper:
    return io.TextIOWrapper(os.fdopen(descriptor, "wb", closefd=False), encoding="utf-8", write_through=True)


def _run(item: dict[str, Any]) -> int:
    """Run an item and return its exit code, or 70 for an exception that no command handled."""
    try:
        if item["simulation"]:
            print(_digest(**item["simulation"]))
            return 0
        sys.argv = ["fieldkit", *item["arguments"]]
        runpy.run_module("fieldkit", run_name="__main__")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
    except Exception:  # noqa: BLE001 (a crash of the tree is a result, and its text is compared)
        traceback.print_exc()
        return 70
    return 0


def _digest(scenario: str, policy: str, seed: int, until_ns: int) -> str:
    """Return the hash over the events of a simulation."""
    from sim_backends.cosim import build, load_scenario  # noqa: PLC0415 (imported from the tree under test, and only if needed)

    return str(build(load_scenario(scenario), policy=policy, seed=seed).run(until_ns).digest)


def _imported_lines() -> dict[str, int]:
    """Return the lines of the modules that are imported, by package."""
    lines: dict[str, int] = {}
    for name, module in list(sys.modules.items()):
        package = name.partition(".")[0]
        if package in {"fieldkit", "sim_backends"} and getattr(module, "__file__", None):
            text = Path(str(module.__file__)).read_text(encoding="utf-8")
            lines[package] = lines.get(package, 0) + text.count("\n")
    return lines


def _help(group: Sequence[str]) -> str:
    """Return the help of a command, or of a group of commands."""
    sys.argv = ["fieldkit", *group, "--help"]
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        runpy.run_module("fieldkit", run_name="__main__")
    return out.getvalue()


def commands() -> list[list[str]]:
    """Return the words of every command and group of commands, read from the help of the parent group."""
    result: list[list[str]] = []
    waiting: list[list[str]] = [[]]
    while waiting:
        group = waiting.pop()
        result.append(group)
        text = _help(group)
        if re.search(r"^  COMMAND$", text, re.MULTILINE):
            waiting += [[*group, name] for name in re.findall(r"^    ([a-z][\w-]*)(?: |$)", text, re.MULTILINE)]
    return result


if __name__ == "__main__":
    if sys.argv[1:] == ["--commands"]:
        print(json.dumps(commands()))
        sys.exit()
    results = Path(sys.argv[2])
    sys.stdin = Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115 (open until exit)
    for number, item in enumerate(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))):
        record(item, results / str(number))
        if item["counts_lines"]:
            (results / "imported_lines.json").write_text(json.dumps(_imported_lines()), encoding="ascii")
