"""Tests of the pytest plugins that make a run fail after leaks or second tries; they run pytest."""

import os
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

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
LEAKS_A_NAMESPACE = """
    def test_it(untouched):
        if first_try("tried"):
            subprocess.run(("ip", "netns", "add", "{name}"), check=True)
"""
WAIT_TIMES_OUT = """
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
    from tests.helpers.host import descendants, is_running
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
        wait_until(lambda: not is_running(orphan), Deadline.after(30))
"""
OTHER_PROCESS = """
    @pytest.fixture
    def other_process():
        # Started before the test has separate namespaces, so it runs in the namespaces of the machine.
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with subprocess.Popen(("sh", "-e"), text=True, **pipes) as shell:
            yield shell
    def test_it(other_process, untouched):
        def run(line):
            other_process.stdin.write(f"{line}; echo done\\n")
            other_process.stdin.flush()
            assert other_process.stdout.readline() == "done\\n"
        name = f"t{os.getpid()}"
        run(f"ip netns add {name}; ip link add {name} type veth peer name in netns {name}")
        run(f"mount -t tmpfs {name} /mnt")
        untouched()
        run(f"umount /mnt; ip link del {name}; ip netns del {name}")
"""
SHARED_FIXTURE = """
    @pytest.fixture(scope="module")
    def lab():
        yield (broken := [])
        print("taken down", broken)
    def test_before(lab):
        pass
    def test_it(lab):
        assert not lab, "the first try has left this state"
        lab.append("node lost")
        assert not first_try("tried")
"""
CHANGES_SIGINT = """
    import signal
    def test_it():
        CHANGE
    def test_after():
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())
"""
RANDOM_FAILURE = """
    @pytest.mark.parametrize("name", range(2))
    def test_it(name):
        assert not first_try(str(name))
"""

SEQUENTIAL, PARALLEL = ("-p", "no:xdist"), ("-n", "2")


def run(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str, *arguments: str) -> pytest.RunResult:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(test_inner="import os\n" + "\n".join(map(_unindent, (FIRST_TRY, test))))
    return pytester.runpytest_subprocess("-p", "no:hypothesispytest", "--end-within", "0.5", *arguments)


def _unindent(text: str) -> str:
    return "\n".join(line.removeprefix("    ") for line in text.splitlines())


@pytest.mark.parametrize("mode", [SEQUENTIAL, PARALLEL], ids=["sequential", "parallel"])
@pytest.mark.parametrize("test", [LEAKS_A_PROCESS, DETACHES_A_PROCESS], ids=["child", "detached"])
def test_a_process_that_a_first_try_leaves_running_fails_the_run(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str, mode: tuple[str, ...]
) -> None:
    result = run(pytester, monkeypatch, test, *mode)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(
        ["*processes left behind*", "sleep 600 (seen after test_inner.py)", "*1 passed, 1 rerun*"]
    )


@pytest.mark.emulated
def test_an_orphan_in_a_terminated_pid_namespace_is_no_leak(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(pytester, monkeypatch, ORPHAN_IN_A_PID_NAMESPACE, *SEQUENTIAL)
    result.stdout.no_fnmatch_line("*processes left behind*")
    assert result.ret == pytest.ExitCode.OK


@pytest.mark.emulated
@pytest.mark.parametrize("test", [LEAKS_AN_INTERFACE, LEAKS_A_NAMESPACE], ids=["interface", "namespace"])
def test_a_first_try_that_leaves_network_state_always_fails(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str
) -> None:
    name = f"left-{os.getpid()}"
    result = run(pytester, monkeypatch, test.replace("{name}", name), *SEQUENTIAL)
    Path("/run/netns", name).unlink(missing_ok=True)  # the name of a namespace is a file
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*LeakError*left*"])


@pytest.mark.parametrize(
    "change",
    ["signal.signal(signal.SIGINT, signal.SIG_IGN)", "signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))"],
)
def test_a_test_that_changes_the_effect_of_ctrl_c_fails_and_later_tests_do_not(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    result = run(pytester, monkeypatch, CHANGES_SIGINT.replace("CHANGE", change), *SEQUENTIAL)
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*LeakError*test_it changed SIGINT*"])


@pytest.mark.emulated
@pytest.mark.parametrize("mode", [SEQUENTIAL, PARALLEL], ids=["sequential", "parallel"])
def test_an_exited_orphan_does_not_block_the_end_of_its_namespace(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, mode: tuple[str, ...]
) -> None:
    result = run(pytester, monkeypatch, ORPHAN_OF_A_NAMESPACE, *mode)
    result.assert_outcomes(passed=1)
    assert result.ret == pytest.ExitCode.OK, str(result.stdout)


def test_a_process_that_does_not_exit_gets_no_second_try(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(pytester, monkeypatch, WAIT_TIMES_OUT, *SEQUENTIAL)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*LeakError: still running*"])


def test_a_second_try_uses_new_module_fixtures(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    result = run(pytester, monkeypatch, SHARED_FIXTURE, *SEQUENTIAL, "-s")
    result.stdout.fnmatch_lines(["*2 passed, 1 rerun*"])
    assert str(result.stdout).count("taken down ['node lost']") == 2


@pytest.mark.emulated
def test_changes_by_other_processes_of_the_machine_do_not_fail_a_test(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(pytester, monkeypatch, OTHER_PROCESS, *SEQUENTIAL)
    assert result.ret == pytest.ExitCode.OK
    result.assert_outcomes(passed=1)


@pytest.mark.parametrize("mode", [SEQUENTIAL, PARALLEL], ids=["sequential", "parallel"])
def test_a_second_try_that_passes_fails_the_run(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, mode: tuple[str, ...]
) -> None:
    result = run(pytester, monkeypatch, RANDOM_FAILURE, *mode)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["*tests that ran twice; none may*", "*test_it?0?", "*2 passed, 2 rerun*"])
