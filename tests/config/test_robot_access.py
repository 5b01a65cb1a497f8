"""Robot access as read by `fieldkit stop` equals that of the full site file; other errors are tolerated."""

from pathlib import Path

import pytest

from fieldkit.config import documents, robot_access
from fieldkit.config.robot_access import RobotAccess
from fieldkit.config.site import load_site
from fieldkit.core.errors import ConfigurationError

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJcfoHM2b/TjeUycyd/kMkG5id0whvOnW10xYBLAo4SR"
SITE = f"""\
backend: field
robots:
  by-agent: {{profile: a, host: 10.0.0.2, user: u, host_key: {KEY}}}
  by-key: {{profile: a, host: b.local, port: 2222, user: u, key: ~/k, host_key: {KEY}, address: 10.0.0.3}}
  by-password: {{profile: a, host: 10.0.0.4, user: u, password: keyring, host_key: {KEY}}}
roles: {{}}
"""
FIELDS = ("host", "port", "user", "key", "password", "host_key")


def test_access_equals_that_of_the_full_site_file(tmp_path: Path) -> None:
    path = tmp_path / "fieldkit.yaml"
    path.write_text(SITE, encoding="utf-8")
    site, document = load_site(path)
    accesses = robot_access.read_access(document)
    assert robot_access.configured_backend(document) == site.backend
    assert list(accesses) == list(site.robots)
    for name, robot in site.robots.items():
        assert [getattr(accesses[name], field) for field in FIELDS] == [getattr(robot, field) for field in FIELDS]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (f"{{host: h, user: u, port: 0, host_key: {KEY}}}", "port of bad must be a number from 1 to 65535"),
        (f"{{host: h, user: u, port: '22', host_key: {KEY}}}", "port of bad must be a number from 1 to 65535"),
        (f"{{host: h, user: u, port: true, host_key: {KEY}}}", "port of bad must be a number from 1 to 65535"),
        (f"{{user: u, host_key: {KEY}}}", "host of bad must be a text"),
        (f"{{host: h, host_key: {KEY}}}", "user of bad must be a text"),
        ("{host: h, user: u}", "host_key of bad must be a text: fieldkit enroll bad"),
        (f"{{host: h, user: u, host_key: {KEY}, key: 3}}", "key of bad must be the path of a file"),
        (f"{{host: h, user: u, host_key: {KEY}, password: hunter2}}", "password of bad must be ask or keyring"),
        (f"{{host: h, user: u, host_key: {KEY}, password: [ask]}}", "password of bad must be ask or keyring"),
        ("nothing", "this entry is not a mapping"),
    ],
)
def test_error_of_one_robot_does_not_affect_the_others(entry: str, message: str) -> None:
    text = SITE.replace("robots:\n", f"robots:\n  bad: {entry}\n").replace("roles: {}", "rolls: 7\ncontrol: no such")
    accesses = robot_access.read_access(documents.parse(text, source="site.yaml"))
    error = accesses.pop("bad")
    assert isinstance(error, ConfigurationError)
    assert (error.what, error.where) == (message, "site.yaml:3")
    assert len(accesses) == 3
    assert all(isinstance(access, RobotAccess) for access in accesses.values())


@pytest.mark.parametrize("text", ["", "7", "[]", "backend: field", "robots: [a]"])
def test_a_file_without_robots_is_an_error(text: str) -> None:
    with pytest.raises(ConfigurationError, match="has no robots"):
        robot_access.read_access(documents.parse(text, source="site.yaml"))
