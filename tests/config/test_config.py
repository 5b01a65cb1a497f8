from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.config.locations import names
from fieldkit.config.profiles import RobotProfile, Tools, load_profile
from fieldkit.config.schema import Strict
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Role
from fieldkit.steps.kinds.ping import Payloads
from fieldkit.trial.procedure import Procedure, load_procedure
from sim_backends.cosim.scenario.schema import PhysicsOptions, PolicyChoice
from sim_backends.emulated.options import EmulatedOptions
from sim_backends.radio.options import RadioOptions
from tests.helpers.paths import ROOT

PROFILE = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
PROCEDURE = (ROOT / "procedures" / "los.yaml").read_text(encoding="utf-8")
SITE = """\
robots:
  a: {profile: turtlebot3_burger}
  b: {profile: turtlebot3_burger}
roles:
  masterless: {sender: a, receiver: b}
"""


def line_of(text: str, part: str) -> int:
    return next(number for number, line in enumerate(text.splitlines(), start=1) if part in line)


@pytest.mark.parametrize("name", names("robots"))
def test_every_shipped_profile_loads(name: str) -> None:
    assert load_profile(name).name == name


@pytest.mark.parametrize("name", names("procedures"))
def test_every_shipped_procedure_loads(name: str) -> None:
    assert load_procedure(name).name == name


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("  interface: wlan0", "  interfce: wlan0", "unknown key interfce; did you mean 'interface'?"),
        ("kind: ugv", "kid: ugv", "unknown key kid; did you mean 'kind'?"),
        ("summary: ROBOTIS", "# summary: ROBOTIS", "required key 'summary' is missing"),
        ("type: sensor_msgs/LaserScan, rate: 5Hz", "type: sensor_msgs/LaserScan, rate: 5", "has no unit"),
        ("type: sensor_msgs/LaserScan, rate: 5Hz", "type: sensor_msgs/LaserScan, rate: 5ft", "unknown unit 'ft'"),
        ("points: 360", "points: many", "valid integer"),
        ("points: 360", "points: 0", "greater than 0"),
        ("{duration_s}", "{duraton_s}", "unknown placeholder"),
        ("  variant: ros1", "  variant: ros3", "'ros3' is none of these: ros1, ros2"),
        ("kind: ugv", "kind: ugv\nkind: uav", "duplicate key 'kind'"),
        ("kind: ugv", "kind: *ugv", "aliases"),
        ("kind: ugv", "kind: [ugv", "not valid YAML"),
    ],
)
def test_a_wrong_profile_names_file_line_and_what_is_meant(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in PROFILE
    path = tmp_path / "robot.yaml"
    path.write_text(PROFILE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        schema.load(path, RobotProfile)
    assert said in caught.value.what
    assert caught.value.where.startswith(f"{path}:")
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("old", "new", "others"),
    [
        ("rate: 5Hz", "rate: 5", 0),  # a list of one topic less is no second mistake
        ("max_speed_m_s: 0.22", "max_speed_m_s: fast", 0),  # neither a whole number nor another
        ("summary: ROBOTIS", "# summary: ROBOTIS", 0),
        ("name: turtlebot3_burger\nsummary: ROBOTIS", "# summary: ROBOTIS", 1),
    ],
)
def test_each_mistake_counts_once(tmp_path: Path, old: str, new: str, others: int) -> None:
    assert old in PROFILE
    path = tmp_path / "robot.yaml"
    path.write_text(PROFILE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        schema.load(path, RobotProfile)
    assert ("(1 more after this one)" in caught.value.what) == bool(others), caught.value.what


def test_the_line_is_the_right_one(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(PROFILE.replace("points: 360", "pionts: 360"), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        schema.load(path, RobotProfile)
    assert caught.value.where == f"{path}:{line_of(PROFILE, 'points: 360')}"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("- record:", "- recrod:", "unknown key recrod; did you mean 'record'?"),
        ("  - record:", "  - name: up\n    record:", "unknown key name; it is a key of record: write it inside"),
        ("        - transfer: {from: sender", "        - transfer: {form: sender", "did you mean 'from'?"),
        ("- transfer: {from: sender, to: receiver", "- transfer: {from: sender, to: sender", "cannot send to itself"),
        ("- ping: {from: sender, to: receiver", "- ping: {from: sender, to: sender", "cannot ping itself"),
        ("robot: sender", "robot: boss", "there is no role boss; give its place"),
        ("duration: 15s", "duration: 15", "has no unit"),
        ("duration: 15s", "duration: 0s", "greater than 0"),
        ("topics: [/scan]", "topics: []", "at least 1 item"),
        ("topics: [/scan]", "topics: ['/scan; reboot']", "'/scan; reboot' is not the name of a topic"),
        (
            "topics: [/scan]",
            "topics: [scan]",
            "in steps.0.record.topics.0: 'scan' is not the name of a topic",
        ),
        ("into: recv.bag", "into: ../recv.bag", "'../recv.bag' is not the name of a file: small letters"),
        ("into: recv.bag", "file: a/b/c.bag", "is not the name of a recording"),
        ("port: 1234\n", "port: 0\n", "greater than 0"),
        ("topology: master", "topology: mesh", "'master' or 'masterless'"),
        ("repeats: 20", "repeats: 20.5", "valid integer"),
        ("repeats: 20", "repeats: '20'", "valid integer"),
        (
            "        - ping: {",
            "        - transfer: {from: sender, to: receiver}\n          ping: {",
            "a step has one kind",
        ),
    ],
)
def test_a_wrong_procedure_names_line_and_what_is_meant(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in PROCEDURE
    path = tmp_path / "los.yaml"
    path.write_text(PROCEDURE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        schema.load(path, Procedure)
    assert said in caught.value.what
    line = int(caught.value.where.rsplit(":", 1)[1])
    assert abs(line - line_of(PROCEDURE, old.splitlines()[0])) <= 1


def test_two_robots_may_record_bags_of_two_names_and_not_of_one() -> None:
    other = "\nsteps:\n  - record: {robot: relay, topics: [/scan], duration: 1s, name: NAME}"
    two = PROCEDURE.replace("\nsteps:", other.replace("NAME", "theirs"), 1)
    procedure = schema.validate(schema.parse(two, source="los.yaml"), Procedure)
    assert {role for placed in procedure.walk() for role in placed.step.records_on()} == {Role.SENDER, Role.RELAY}
    one = PROCEDURE.replace("\nsteps:", other.replace("NAME", "scan"), 1)
    with pytest.raises(ConfigurationError, match=r"a file scan\.bag is there already"):
        schema.validate(schema.parse(one, source="los.yaml"), Procedure)


def test_a_transfer_without_a_file_needs_a_bag_of_its_sender() -> None:
    document = schema.parse(PROCEDURE.replace("robot: sender", "robot: receiver", 1), source="los.yaml")
    said = "the transfer from sender names no file, and no step before it records on sender"
    with pytest.raises(ConfigurationError, match=said):
        schema.validate(document, Procedure)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("receiver: b", "receiver: c", "names 'c'; the robots are: a, b"),
        ("receiver: b", "receiver: a", "one robot plays two roles"),
        ("receiver: b", "reciever: b", "roles.masterless.reciever: did you mean 'receiver'?"),
        ("  a: {profile", "  A b: {profile", "'A b' cannot be a key here: 'A b' is not a name: small letters"),
        ("{profile: turtlebot3_burger}", "{profile: turtlebot3_burger, hots: x}", "did you mean 'host'?"),
    ],
)
def test_a_wrong_site_file_says_so(old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        schema.validate(schema.parse(SITE.replace(old, new, 1), source="fieldkit.yaml"), Site)
    assert said in caught.value.what


def test_a_part_keeps_its_lines_and_its_place() -> None:
    document = schema.parse("a:\n  b:\n    robots: 1\n", source="x.yaml").part("a", "b")
    assert document.where(("robots",)) == "x.yaml:3"
    with pytest.raises(ConfigurationError, match=r"in a\.b: "):
        schema.validate(document, Site)


def test_a_missing_file_and_a_binary_one_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        schema.read(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        schema.read(tmp_path / "binary.yaml")


def test_on_and_off_stay_text_as_in_yaml_1_2() -> None:
    assert schema.parse("a: on\nb: true\nc: 1:30\nd: 1e3\ne: ~", source="x").data == {
        "a": "on",
        "b": True,
        "c": "1:30",
        "d": 1000.0,
        "e": None,
    }


def test_an_unknown_name_offers_the_nearest() -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_profile("turtlebot3_burgr")
    assert "turtlebot3_burger" in caught.value.remedy


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("rtt", "did you mean 'rtt_loss' or 'rtt_median_s'?"),
        ("delta", "did you mean 'cliffs_delta'?"),
        ("rtt_los", "did you mean 'rtt_loss'?"),
        ("topic_loss", "did you mean 'up.topic_loss'?"),
        ("", "look"),
    ],
)
def test_a_word_of_several_names_offers_each(name: str, remedy: str) -> None:
    assert (
        nearest(name, ("rtt_loss", "ip_loss", "delay_s", "cliffs_delta", "rtt_median_s", "up.topic_loss"), "look")
        == remedy
    )


def test_a_labs_own_folder_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    own = PROFILE.replace("interface: wlan0", "interface: wlan7")
    (tmp_path / "robots" / "turtlebot3_burger.yaml").write_text(own, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_profile("turtlebot3_burger").radio.interface == "wlan7"
    assert load_profile("duckiedrone").radio.interface == "wlan0"


class Text(schema.Strict):
    text: str


@given(
    st.from_regex(r"[-+.0-9eE_:xnoft~]{1,12}", fullmatch=True)
    | st.text(st.characters(categories=["L", "N", "P", "S", "Zs"]), max_size=20)
)
@example("6372e70369712148")
@example("0123e4")
@example("1_000")
@example("on")
@example("a\N{NEXT LINE}0")
@example("a\N{LINE SEPARATOR}0\r")
def test_text_that_looks_like_something_else_survives_being_written_and_read_again(text: str) -> None:
    written = Text(text=text)
    assert schema.validate(schema.parse(schema.dump(written), source="x"), Text) == written


class Quantities(schema.Strict):
    step: schema.Duration
    rate: schema.Bits
    size: schema.Bytes


@pytest.mark.parametrize("step", ["50us", "0.000000001s", "0s", "99999999999s"])
def test_quantities_of_any_size_survive_being_written_and_read_again(step: str) -> None:
    written = Quantities.model_validate({"step": step, "rate": "3bit/s", "size": "99GB"})
    read = schema.validate(schema.parse(schema.dump(written), source="x"), Quantities)
    assert read.model_dump_json() == written.model_dump_json()
    assert read.step == pytest.approx(written.step)


@pytest.mark.parametrize("model", [Tools, Payloads, RadioOptions, PhysicsOptions, PolicyChoice, EmulatedOptions])
def test_defaults_are_what_an_empty_mapping_gives(model: type[Strict]) -> None:
    assert model.defaults() == model.model_validate({})
    assert schema.dump(model.defaults()) == schema.dump(model.model_validate({}))
