"""Run pytest in pytest: leaks and many second tries fail a run, strangers on the machine do not."""

import os
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.reruns import ALLOWED

CONFTEST = """
    pytest_plugins = ("tests.helpers.leaks", "tests.helpers.reruns")
    def pytest_configure(config):
        config.addinivalue_line("markers", "emulated: real programs")
"""
FIRST_TRY = """
    import subprocess
    from pathlib import Path
    import pytest
    pytestmark = pytest.mark.emulated
    def first_try(name):
        mark = Path(__file__).with_name(name)
        if mark.exists():
            return False
        mark.touch()
        return True
"""
LEAKS_A_PROCESS = """
    def test_it():
        if first_try("tried"):
            subprocess.Popen(("sleep", "600"), start_new_session=True)
            raise ValueError
"""
DETACHES_A_PROCESS = """
    def test_it():
        if first_try("tried"):
            subprocess.run(("sh", "-c", "setsid sleep 600 &"))
            raise ValueError
"""
ORPHAN_IN_A_PID_NAMESPACE = """
    import os, signal, time
    def children(pid):
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    def only_child(pid):
        while not children(pid):
            time.sleep(0.01)
        return children(pid)[0]
    def test_it():
        unshare = subprocess.Popen(("unshare", "--pid", "--fork", "sleep", "600"))
        init = only_child(unshare.pid)
        nsenter = subprocess.Popen(("nsenter", f"--target={init}", "--pid", "sleep", "600"))
        only_child(nsenter.pid)
        for process in (nsenter, unshare):
            process.kill()
            process.wait()
        os.kill(init, signal.SIGKILL)
"""
LEAKS_AN_INTERFACE = """
    def test_it(untouched):
        if first_try("tried"):
            subprocess.run(("ip", "tuntap", "add", "left", "mode", "tun"), check=True)
"""
LEAKS_A_NAME = """
    def test_it(untouched):
        if first_try("tried"):
            subprocess.run(("ip", "netns", "add", "{name}"), check=True)
"""
WAITS_IN_VAIN = """
    from tests.helpers.host import wait_for_end
    def test_it():
        with subprocess.Popen(("sleep", "600")) as child:
            if first_try("tried"):
                try:
                    wait_for_end({child.pid}, within_s=0.0)
                finally:
                    child.kill()
            child.kill()
"""
ORPHAN_OF_A_NAMESPACE = """
    from tests.helpers.host import alive, descendants
    from tests.helpers.sshd import wait_until
    from fieldkit.core.deadline import Deadline
    def child_of(process):
        wait_until(lambda: descendants(process.pid), Deadline.after(30))
        (child,) = descendants(process.pid)
        return child
    def test_it():
        robot = subprocess.Popen(("unshare", "--pid", "--fork", "--kill-child", "sleep", "600"))
        entered = subprocess.Popen(("nsenter", "--target", str(child_of(robot)), "--pid", "sleep", "600"))
        orphan = child_of(entered)
        for process in (entered, robot):
            process.kill()
            process.wait()
        wait_until(lambda: not alive(orphan), Deadline.after(30))
"""
STRANGER = """
    @pytest.fixture
    def stranger():
        # Begun before the test has namespaces of its own, so it works in those of the machine.
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with subprocess.Popen(("sh", "-e"), text=True, **pipes) as shell:
            yield shell
    def test_it(stranger, untouched):
        def do(line):
            stranger.stdin.write(f"{line}; echo done\\n")
            stranger.stdin.flush()
            assert stranger.stdout.readline() == "done\\n"
        name = f"t{os.getpid()}"
        do(f"ip netns add {name}; ip link add {name} type veth peer name in netns {name}; mount -t tmpfs {name} /mnt")
        untouched()
        do(f"umount /mnt; ip link del {name}; ip netns del {name}")
"""
SHARED = """
    @pytest.fixture(scope="module")
    def lab():
        yield (broken := [])
        print("taken down", broken)
    def test_before(lab):
        pass
    def test_it(lab):
        assert not lab, "a try before this one left it so"
        lab.append("node lost")
        assert not first_try("tried")
"""
TOO_MANY = """
    @pytest.mark.parametrize("name", range({tests}))
    def test_it(name):
        assert not first_try(str(name))
"""

ALONE, SIDE_BY_SIDE = ("-p", "no:xdist"), ("-n", "2")


def run(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str, *words: str) -> pytest.RunResult:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(test_inner="import os\n" + "\n".join(map(_flat, (FIRST_TRY, test))))
    return pytester.runpytest_subprocess("-p", "no:hypothesispytest", "--end-within", "0.5", *words)


def _flat(text: str) -> str:
    return "\n".join(line.removeprefix("    ") for line in text.splitlines())


@pytest.mark.parametrize("how", [ALONE, SIDE_BY_SIDE], ids=["alone", "side by side"])
@pytest.mark.parametrize("test", [LEAKS_A_PROCESS, DETACHES_A_PROCESS], ids=["child", "detached"])
def test_a_process_that_a_first_try_leaves_fails_the_run(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str, how: tuple[str, ...]
) -> None:
    done = run(pytester, monkeypatch, test, *how)
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.stdout.fnmatch_lines(
        ["*processes left behind*", "sleep 600 (seen after test_inner.py)", "*1 passed, 1 rerun*"]
    )


@pytest.mark.emulated
def test_an_orphan_in_a_pid_namespace_that_ended_is_not_left_behind(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run(pytester, monkeypatch, ORPHAN_IN_A_PID_NAMESPACE, *ALONE)
    done.stdout.no_fnmatch_line("*processes left behind*")
    assert done.ret == pytest.ExitCode.OK


@pytest.mark.emulated
@pytest.mark.parametrize("test", [LEAKS_AN_INTERFACE, LEAKS_A_NAME], ids=["interface", "namespace"])
def test_what_a_first_try_leaves_in_the_namespaces_of_the_test_is_no_matter_of_luck(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str
) -> None:
    name = f"left-{os.getpid()}"
    done = run(pytester, monkeypatch, test.replace("{name}", name), *ALONE)
    Path("/run/netns", name).unlink(missing_ok=True)  # `ip` keeps a name as a file, too
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.assert_outcomes(passed=1, errors=1)
    done.stdout.fnmatch_lines(["*LeakError*left*"])


@pytest.mark.emulated
@pytest.mark.parametrize("how", [ALONE, SIDE_BY_SIDE], ids=["alone", "side by side"])
def test_an_orphan_that_has_ended_does_not_keep_its_namespace_from_ending(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, how: tuple[str, ...]
) -> None:
    done = run(pytester, monkeypatch, ORPHAN_OF_A_NAMESPACE, *how)
    done.assert_outcomes(passed=1)
    assert done.ret == pytest.ExitCode.OK, str(done.stdout)


def test_waiting_in_vain_for_an_end_gets_no_second_try(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run(pytester, monkeypatch, WAITS_IN_VAIN, *ALONE)
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.assert_outcomes(failed=1)
    done.stdout.fnmatch_lines(["*LeakError: still running*"])


def test_a_second_try_shares_nothing_with_the_first(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run(pytester, monkeypatch, SHARED, *ALONE, "-s")
    assert done.ret == pytest.ExitCode.OK
    done.stdout.fnmatch_lines(["*2 passed, 1 rerun*"])
    assert str(done.stdout).count("taken down ['node lost']") == 2


@pytest.mark.emulated
def test_what_strangers_do_on_the_machine_fails_nothing(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run(pytester, monkeypatch, STRANGER, *ALONE)
    assert done.ret == pytest.ExitCode.OK
    done.assert_outcomes(passed=1)


@pytest.mark.parametrize("how", [ALONE, SIDE_BY_SIDE], ids=["alone", "side by side"])
def test_more_second_tries_than_allowed_fail_a_run(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, how: tuple[str, ...]
) -> None:
    done = run(pytester, monkeypatch, TOO_MANY.format(tests=ALLOWED + 1), *how)
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.stdout.fnmatch_lines(
        [
            f"*{ALLOWED + 1} tests ran twice, at most {ALLOWED} may*",
            "*test_it?0?",
            f"*{ALLOWED + 1} passed, {ALLOWED + 1} rerun*",
        ]
    )


def test_as_many_as_allowed_do_not(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    done = run(pytester, monkeypatch, TOO_MANY.format(tests=ALLOWED), *ALONE)
    assert done.ret == pytest.ExitCode.OK
    done.stdout.fnmatch_lines([f"*{ALLOWED} passed, {ALLOWED} rerun*"])


def test_both_parts_of_a_run_count(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    words = (*ALONE, "--rerun-log", "reruns.txt")
    assert run(pytester, monkeypatch, TOO_MANY.format(tests=ALLOWED), *words).ret == pytest.ExitCode.OK
    second = run(pytester, monkeypatch, TOO_MANY.format(tests=ALLOWED + 1), *words)
    assert second.ret == pytest.ExitCode.TESTS_FAILED, "one more, and those of the first part"
    second.stdout.fnmatch_lines([f"*{ALLOWED + 1} tests ran twice, at most {ALLOWED} may*"])
