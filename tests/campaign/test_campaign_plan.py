"""The campaign file: its meaning, and its error messages."""

from pathlib import Path

import pytest

from fieldkit.campaign.plan import load_campaign, load_procedures, trials_of
from fieldkit.cli import main
from fieldkit.core.errors import ConfigurationError

LAWN = """\
name: lawn
procedures: [los, nlos]
distances: [10ft, 20ft]
topologies: [master, masterless]
seed: 7
"""


def names(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "lawn.yaml"
    path.write_text(text, encoding="utf-8")
    campaign, document = load_campaign(path)
    return [str(trial) for trial in trials_of(campaign, load_procedures(campaign, document), document)]


@pytest.mark.ros
def test_a_campaign_combines_distances_procedures_and_topologies(tmp_path: Path) -> None:
    trial_names = names(tmp_path, LAWN)
    assert sorted(trial_names) == [
        f"{procedure} {distance} {topology}"
        for procedure in ("los", "nlos")
        for distance in ("10ft", "20ft")
        for topology in ("master", "masterless")
    ]


@pytest.mark.ros
def test_exclusions_match_trials_by_all_their_keys(tmp_path: Path) -> None:
    trial_names = names(tmp_path, f"{LAWN}except: [{{topology: master, distance: 240 cm}}]\n".replace("20ft", "2.4m"))
    assert len(trial_names) == 6
    assert not [name for name in trial_names if name.endswith("2.4m master")]
    assert len(names(tmp_path, f"{LAWN}except: [{{procedure: nlos}}]\n")) == 4


@pytest.mark.ros
@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("seed: 7", "sed: 7", 5, "did you mean 'seed'?"),
        ("seed: 7", "", 1, "required key 'seed' is missing"),
        ("seed: 7", "seed: -1", 5, "greater than or equal to 0"),
        ("name: lawn", "name: ../lawn", 1, "in name"),
        ("20ft", "20", 3, "has no unit"),
        ("20ft", "20feet", 3, "unknown unit 'feet'"),
        ("20ft", "3.048m", 3, "occurs twice"),
        ("20ft", "0m", 3, "not above zero"),
        ("[10ft, 20ft]", "[]", 3, "at least 1"),
        ("[los, nlos]", "[los, nslo]", 2, "did you mean 'nlos'?"),
        ("[los, nlos]", "[los, los]", 2, "occurs twice"),
        ("masterless]", "mesh]", 4, "'mesh' is not one of: master, masterless"),
        ("seed: 7", "seed: 7\nrepeats: 0", 6, "greater than 0"),
        ("seed: 7", "seed: 7\nrecord: 0s", 6, "greater than 0"),
        ("seed: 7", "seed: 7\nwalk: far", 6, "not a length"),
        ("seed: 7", "seed: 7\nprotocols: [sctp]", 6, "'sctp' is not one of: tcp, udp"),
        ("seed: 7", "seed: 7\nexcept: [{distance: 55ft}]", 6, "excludes nothing"),
        ("seed: 7", "seed: 7\nexcept: [{}]", 6, "excludes every trial"),
    ],
)
def test_an_invalid_file_is_reported_with_its_line(
    tmp_path: Path, old: str, new: str, line: int, message: str
) -> None:
    assert old in LAWN
    with pytest.raises(ConfigurationError) as error_info:
        names(tmp_path, LAWN.replace(old, new))
    assert error_info.value.where == f"{tmp_path / 'lawn.yaml'}:{line}"
    assert message in f"{error_info.value.what} {error_info.value.remedy}"
    assert error_info.value.remedy


ROVERS = """\
backend: field
robots:
  turtlebot-1: {profile: turtlebot3_burger, host: 10.0.0.2, user: ubuntu, host_key: KEY}
  turtlebot-2: {profile: turtlebot3_burger, host: 10.0.0.3, user: ubuntu, host_key: KEY}
roles:
  masterless: {sender: turtlebot-1, receiver: turtlebot-2}
"""
KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJcfoHM2b/TjeUycyd/kMkG5id0whvOnW10xYBLAo4SR"
REDUCED_MOTION = "turtlebot-2 moves 29.5 m away, at 0.22 m/s; 60 m away, at 2 m/s is beyond its limits"


@pytest.mark.motion
def test_reduced_values_are_reported_once_before_the_first_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fieldkit.yaml").write_text(ROVERS.replace("KEY", KEY), encoding="utf-8")
    text = LAWN.replace("[los, nlos]", "[driveaway]").replace("[master, masterless]", "[masterless]")
    Path("lawn.yaml").write_text(text, encoding="utf-8")
    assert main(["campaign", "lawn.yaml", "--dry-run", "--allow-motion"]) == 0
    output = capsys.readouterr().out
    assert "driveaway 20ft masterless" in output
    assert output.count(REDUCED_MOTION) == 1
