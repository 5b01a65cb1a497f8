"""paramiko as fieldkit imports it: sooner, and whole."""

import subprocess
import sys

LIMIT_S = 60.0

SCRIPT = """\
import sys
from fieldkit.remote import ssh
print({"asyncio", "invoke", "unittest"} & set(sys.modules))
import invoke, paramiko.config
print(paramiko.config.invoke.run is invoke.run)
"""


def test_what_paramiko_seldom_needs_is_imported_when_it_needs_it() -> None:
    done = subprocess.run(
        (sys.executable, "-c", SCRIPT), stdout=subprocess.PIPE, text=True, timeout=LIMIT_S, check=True
    )
    assert done.stdout.splitlines() == ["set()", "True"]
