"""Jobs of a session that installed packages add with entry points."""

from pathlib import Path

import pytest

from fieldkit.core import plugins
from fieldkit.core.model import Role
from fieldkit.trial import session_jobs
from fieldkit.trial.check import software
from tests.helpers.casts import CAST, plain_plan
from tests.helpers.outside_packages import write_package

JOBS = """\
from fieldkit.core.model import Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.scene import BY_FIELDKIT, Planned

def planned(cast, session):
    job = Job(folder=jobs.work_folder(f"logger-{session}", "1"), name="logger", argv=("logger",), limit_s=9, log="l")
    yield Planned(Role.SENDER, job, program="logger", permitted_causes=BY_FIELDKIT, remedy="install logger")
"""


@pytest.fixture(autouse=True)
def _install_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "more_jobs.py").write_text(JOBS, encoding="utf-8")
    write_package(tmp_path, "more-jobs", f"[{plugins.SESSION_JOBS}]\nloggers = more_jobs:planned\n")
    monkeypatch.syspath_prepend(tmp_path)


def test_a_package_adds_a_job_to_a_session() -> None:
    (planned,) = session_jobs.planned_jobs(CAST, "s1")
    assert (planned.role, planned.job.name) == (Role.SENDER, "logger")
    assert "/logger-s1/" in planned.job.folder


def test_preflight_checks_the_program_of_a_job() -> None:
    plan = plain_plan()
    assert "program logger" in software.commands(plan, Role.SENDER)
    assert "program logger" not in software.commands(plan, Role.RECEIVER)
