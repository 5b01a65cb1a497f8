"""`fieldkit cosim conform`: the documented examples conform, and each failure is printed with request and answer."""

import io
import json
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from fieldkit.cli import main
from tests.helpers.federate_examples import EXAMPLES
from tests.helpers.nightly import mark_nightly
from tests.helpers.runs import Run


def conform(*words: str) -> Run:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(("cosim", "conform", *words))
    return Run(code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def carts_in_c(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("c") / "carts"
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
    subprocess.run(["cc", *strict, "-o", program, EXAMPLES / "carts.c", "-lm"], check=True, timeout=120)
    return program


@pytest.fixture
def carts_in_python() -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    process = subprocess.Popen([sys.executable, EXAMPLES / "carts.py", f"tcp-listen:127.0.0.1:{port}"])
    yield f"tcp:127.0.0.1:{port}"
    process.terminate()
    process.wait()


@pytest.mark.parametrize("windows", mark_nightly([2000, 1_000_000]))
def test_the_example_in_c_conforms(windows: int, carts_in_c: Path) -> None:
    run = conform(str(carts_in_c), "--windows", str(windows))
    assert run.code == 0, run.out
    assert "carts in C" in run.err
    assert "20 checks passed, 2 not applicable, 0 failed" in run.err


def test_the_example_in_python_conforms(carts_in_python: str) -> None:
    run = conform(carts_in_python, "--windows", "500")
    assert run.code == 0, run.out
    assert "20 checks passed, 2 not applicable, 0 failed" in run.err


def test_a_failure_is_printed_with_request_and_answer_and_exits_with_code_1(tmp_path: Path, carts_in_c: Path) -> None:
    source = (EXAMPLES / "carts.c").read_text(encoding="utf-8")
    broken = tmp_path / "broken.c"
    broken.write_text(source.replace("put(answer, (uint64_t)at_ns, 8)", "put(answer, (uint64_t)to_ns, 8)"))
    subprocess.run(["cc", "-std=c99", "-o", tmp_path / "broken", broken, "-lm"], check=True, timeout=120)
    run = conform("--role", "physics", "--format", "json", "--", str(tmp_path / "broken"))
    assert run.code == 1
    failures = {result["name"]: result for result in json.loads(run.out) if result["failure"]}
    assert failures.keys() == {"remainders", "drift"}
    assert "returned the states at 1100000 ns instead of 1000000 ns" in failures["remainders"]["failure"]
    # to_ns 1100000 is 0xc8e0 + 0x10 << 16.
    assert re.match(r"advance_physics, 36 bytes: .* e0c81000 ", failures["remainders"]["request"])
    assert re.match(r"states to request 3, \d+ bytes; after the header .*e0c81000 ", failures["remainders"]["answer"])
    text = conform("--role", "physics", "--windows", "2", str(tmp_path / "broken")).out
    assert "FAILED   remainders: " in text
    assert "         request: advance_physics, 36 bytes: " in text


def test_a_program_that_is_not_a_federate_is_an_error() -> None:
    run = conform("--", sys.executable, "-c", "print('hello')")
    assert run.code == 1
    assert "error: network (" in run.err
    assert "failed at the request to begin a run as network" in run.err or "malformed frame" in run.err
