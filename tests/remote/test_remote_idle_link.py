"""The loss of an idle link, for example while the operator walks, is detected soon after its next use."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from fieldkit.core.deadline import Deadline
from tests.helpers.forwarder import Forwarder
from tests.helpers.sshd import Server, server, wait_until

__all__ = ["server"]

DETECTION_LIMIT_S = 10.0
SOON = 60.0


@pytest.mark.quiet
def test_loss_of_an_idle_link_is_detected_within_10_s(server: Server) -> None:
    notices: list[str] = []
    with Forwarder({"robot": server.connect}) as links, ThreadPoolExecutor(1) as pool:
        shell = server.shell(connect=lambda within_s: links.reach("robot", within_s), on_notice=notices.append)
        shell.run(("true",), deadline=Deadline.after(SOON))
        links.cut("robot")
        links.drop("robot")
        start_s = time.monotonic()
        future = pool.submit(shell.run, ("echo", "back"), deadline=Deadline.after(SOON))
        wait_until(lambda: bool(notices), Deadline.after(SOON))
        assert time.monotonic() - start_s < DETECTION_LIMIT_S
        links.restore("robot")
        assert future.result(SOON).stdout == b"back\n"
        shell.close()
