"""The site file: the template is valid, and pinning a host key changes nothing else."""

import difflib
import itertools
import stat
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.backends.registry import load_backend
from fieldkit.config import profiles
from fieldkit.config.robot_access import configured_backend
from fieldkit.config.site import load_site
from fieldkit.config.site_edits import _with_value, create_site_file, pin_host_key
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Role, Topology

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJcfoHM2b/TjeUycyd/kMkG5id0whvOnW10xYBLAo4SR"
OTHER = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIEnG9vvsSAQ0YOb9EkhjAcC5JgnnZohCQzEpuN6gbFXp"

LAYOUTS = {
    "block": "robots:\n  a:\n    profile:   x   # aligned\n    host: h  # last\n\n  # of b\n  b: {profile: y}\n",
    "flow": "robots: {a: {profile: x, host: 'h'  }, b: {profile: y}} # end\n",
    "flow with a comma at its end": "robots:\n  a: {profile: x, host: h,}\n  b: {profile: y}\n",
    "flow over lines": "robots:\n  a: {profile: x,\n      host: h}  # here\n  b: {profile: y}\n",
    "windows": "robots:\r\n  a:\r\n    profile: x\r\n    host: h # last\r\n  b:\r\n    profile: y\r\n",
    "no line end": "robots:\n  b: {profile: y}\n  a:\n    profile: x\n    host: h",
    "empty": "robots:\n  a:\n    host_key:   # not yet\n    profile: x\n  b: {profile: y}\n",
    "pinned": f"robots:\n  a:\n    host_key: {OTHER}  # of May\n    profile: x\n  b: {{profile: y}}\n",
    "pinned in quotes": f'robots: {{a: {{host_key: "{OTHER}", profile: x}}, b: {{profile: y}}}}\n',
    "nested": "robots:\n  a:\n    profile: x\n    link:\n      - host: h\n\n  # of b\n  b: {profile: y}\n",
    "deep": "---\nrobots:\n        a:\n                profile: x\n        b: {profile: y}\n...\n",
}


@pytest.mark.parametrize("text", LAYOUTS.values(), ids=LAYOUTS)
def test_pinning_changes_nothing_else(text: str, tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_bytes(text.encode())
    expected = yaml.safe_load(text)
    pin_host_key(path, "a", KEY)
    after = path.read_bytes().decode()
    expected["robots"]["a"]["host_key"] = KEY
    assert yaml.safe_load(after) == expected
    without_key, text_without_old_key = after.replace(KEY, ""), text.replace(f'"{OTHER}"', "").replace(OTHER, "")
    changes = [
        change
        for change in difflib.ndiff(list(text_without_old_key), list(without_key))
        if not change.startswith("  ")
    ]
    assert all(change.startswith("+ ") for change in changes), "nothing is removed"
    assert "".join(change[2:] for change in changes).strip(' ,:\r\n"') in {"", "host_key"}


def robot_block(name: str, comment: str, blank: int, indent: int) -> str:
    lines = [f"{name}:  # {comment}", f"{' ' * indent}# {comment}", f"{' ' * indent}profile:  x"]
    return "\n".join(f"  {line}" for line in lines) + "\n" * (blank + 1)


@given(
    names=st.lists(
        st.sampled_from(["on", "no", "null", "true"]) | st.from_regex(r"[a-z][a-z0-9-]{0,8}", fullmatch=True),
        min_size=1,
        max_size=4,
        unique=True,
    ),
    comment=st.text(st.characters(categories=["L", "N", "P", "S"]), max_size=12),
    blank=st.integers(0, 2),
    indent=st.integers(1, 5),
    data=st.data(),
)
def test_pinning_adds_one_line_to_a_robot_in_block_style(
    names: list[str], comment: str, blank: int, indent: int, data: st.DataObject
) -> None:
    text = f"# {comment}\nrobots:\n" + "".join(robot_block(name, comment, blank, indent) for name in names)
    robot = data.draw(st.sampled_from(names))
    old_lines, new_lines = text.splitlines(), _with_value(text, ("robots", robot, "host_key"), KEY).splitlines()
    (added_line,) = [line for line in new_lines if KEY in line]
    assert added_line == f"{' ' * (indent + 2)}host_key: {KEY}"
    new_lines.remove(added_line)
    assert new_lines == old_lines
    # `BaseLoader` reads all scalars as text: a robot may be named `on`, a boolean in YAML 1.1.
    parsed = yaml.load(_with_value(text, ("robots", robot, "host_key"), KEY), Loader=yaml.BaseLoader)
    assert parsed["robots"][robot] == {"profile": "x", "host_key": KEY}


def test_file_that_cannot_be_edited_is_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    text = "robots:\n  a:\n    profile: |\n      x\n  b: {profile: y}\n"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="cannot be inserted") as error_info:
        pin_host_key(path, "a", KEY)
    assert error_info.value.remedy == f"add it in an editor: host_key: {KEY}"
    assert path.read_text(encoding="utf-8") == text


def test_permissions_and_symbolic_links_are_kept(tmp_path: Path) -> None:
    target, link = tmp_path / "real.yaml", tmp_path / "site.yaml"
    target.write_text(LAYOUTS["block"], encoding="utf-8")
    target.chmod(0o640)
    link.symlink_to(target)
    pin_host_key(link, "a", KEY)
    assert link.is_symlink()
    assert KEY in target.read_text(encoding="utf-8")
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert sorted(tmp_path.iterdir()) == [target, link]


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "site.yaml"
    path.write_text(LAYOUTS["block"], encoding="utf-8")

    def raise_disk_full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fieldkit.core.files.os.fsync", raise_disk_full)
    with pytest.raises(ConfigurationError, match="No space left"):
        pin_host_key(path, "a", KEY)
    assert path.read_text(encoding="utf-8") == LAYOUTS["block"]
    assert list(tmp_path.iterdir()) == [path]


def test_template_is_valid_and_every_line_has_a_comment(tmp_path: Path) -> None:
    path = tmp_path / "fieldkit.yaml"
    create_site_file(path)
    site, _ = load_site(path)
    for robot in site.robots.values():
        profiles.load_profile(robot.profile)
    lines_of_first_robot = path.read_text(encoding="utf-8").partition("  turtlebot-2:")[0].splitlines()
    for previous_line, line in itertools.pairwise(lines_of_first_robot):
        if line and not line.lstrip().startswith("#") and line != "robots:":
            assert previous_line.lstrip().startswith("#"), line


def test_a_site_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "fieldkit.yaml"
    path.write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="not overwritten"):
        create_site_file(path)
    assert path.read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("text", ["emulated: {physics: kinematic}\n", "backend: emulated\nros_master: relay\n"])
def test_a_site_file_without_robots_has_the_default_robots_of_the_emulated_backend(text: str, tmp_path: Path) -> None:
    path = tmp_path / "fieldkit.yaml"
    path.write_text(text, encoding="utf-8")
    site, document = load_site(path)
    assert site.backend == configured_backend(document) == "emulated"
    cast = load_backend(site.backend, site, document).cast(Topology.MASTER)
    assert {role: robot.name for role, robot in cast.items()} == {
        Role.SENDER: "turtlebot-1",
        Role.RECEIVER: "turtlebot-2",
        Role.RELAY: "duckiedrone-1",
    }
    assert cast[Role.SENDER].ros_master == (cast[Role.RELAY].address if site.ros_master else "")
    with pytest.raises(ConfigurationError, match="the field backend needs robots and roles") as error_info:
        load_backend("field", site, document)
    assert error_info.value.where == f"{path}:1"
