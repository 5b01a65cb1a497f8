"""Waiting for a machine: output, exit code, Ctrl-C, a machine that exits early. A shell replaces QEMU."""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import TestbedLostError
from sim_backends.emulated.linux_wifi.virtual_machine import Machine

LIMIT_S = 60.0


@contextmanager
def machine(folder: Path, script: str) -> Iterator[Machine]:
    (folder / "shared").mkdir()
    process = subprocess.Popen(("/bin/sh", "-c", script), cwd=folder / "shared", start_new_session=True)
    try:
        yield Machine(process, folder)
    finally:
        process.kill()
        process.wait()


def test_output_is_reported_once_and_the_exit_code_is_returned(tmp_path: Path) -> None:
    reported_output: list[bytes] = []
    script = "echo one >output; sleep 0.5; echo two >>output; echo 3 >output.code"
    with machine(tmp_path, script) as started_machine:
        result = started_machine.wait(Deadline.after(LIMIT_S), reported_output.append)
    assert (result.code, result.output) == (3, "one\ntwo\n")
    assert b"".join(reported_output) == b"one\ntwo\n"


def test_ctrl_c_is_passed_to_the_machine_and_its_exit_code_is_returned(tmp_path: Path) -> None:
    script = "touch output; while [ ! -e interrupt ]; do sleep 0.1; done; echo 130 >output.code"

    def interrupt(_data: bytes) -> None:
        if not interrupts:
            interrupts.append(True)
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()

    interrupts: list[bool] = []
    with machine(tmp_path, script) as started_machine:
        assert started_machine.wait(Deadline.after(LIMIT_S), interrupt).code == 130


def test_a_second_ctrl_c_ends_the_wait(tmp_path: Path) -> None:
    interrupts: list[bool] = []
    with machine(tmp_path, "exec sleep 600") as started_machine, pytest.raises(KeyboardInterrupt):
        started_machine.wait(
            Deadline.after(LIMIT_S), lambda _data: None if interrupts else schedule_interrupts(interrupts)
        )
    assert (tmp_path / "shared/interrupt").exists()


def schedule_interrupts(interrupts: list[bool]) -> None:
    interrupts.append(True)
    for delay_s in (0.1, 1.0):
        threading.Timer(delay_s, os.kill, (os.getpid(), signal.SIGINT)).start()


def test_a_machine_that_exits_early_is_reported_with_its_last_output(tmp_path: Path) -> None:
    (tmp_path / "console").write_text("[1.0] booting\n[2.0] Kernel panic\n")
    with (
        machine(tmp_path, "exit 0") as started_machine,
        pytest.raises(TestbedLostError, match=r"ended before its script.*panic"),
    ):
        started_machine.wait(Deadline.after(LIMIT_S))


def test_a_machine_that_does_not_exit_is_reported(tmp_path: Path) -> None:
    with (
        machine(tmp_path, "exec sleep 600") as started_machine,
        pytest.raises(TestbedLostError, match="did not switch off in time"),
    ):
        started_machine.wait(Deadline.after(0.3))
