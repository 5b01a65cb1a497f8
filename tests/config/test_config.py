from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.config.locations import names
from fieldkit.config.profiles import RobotProfile, Tools, load_profile
from fieldkit.config.schema import Strict
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Role
from fieldkit.steps.capabilities import Records
from fieldkit.steps.kinds.ping import Payloads
from fieldkit.trial.procedure import Procedure, load_procedure
from sim_backends.cosim.scenario.schema import PhysicsOptions, PolicyChoice
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.radio.radio_options import RadioOptions
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


@pytest.mark.motion
@pytest.mark.parametrize("name", names("procedures"))
def test_every_shipped_procedure_loads(name: str) -> None:
    assert load_procedure(name).name == name


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  interface: wlan0", "  interfce: wlan0", "unknown key interfce; did you mean 'interface'?"),
        ("kind: ugv", "kid: ugv", "unknown key kid; did you mean 'kind'?"),
        ("summary: ROBOTIS", "# summary: ROBOTIS", "required key 'summary' is missing"),
        ("type: sensor_msgs/LaserScan, rate: 5Hz", "type: sensor_msgs/LaserScan, rate: 5", "has no unit"),
        ("type: sensor_msgs/LaserScan, rate: 5Hz", "type: sensor_msgs/LaserScan, rate: 5ft", "unknown unit 'ft'"),
        ("points: 360", "points: many", "is not a whole number"),
        ("points: 360", "points: 0", "greater than 0"),
        ("{duration_s}", "{duraton_s}", "unknown placeholder"),
        ("  variant: ros1", "  variant: ros3", "'ros3' is not one of: ros1, ros2"),
        ("kind: ugv", "kind: ugv\nkind: uav", "duplicate key 'kind'"),
        ("kind: ugv", "kind: *ugv", "aliases"),
        ("kind: ugv", "kind: [ugv", "not valid YAML"),
    ],
)
def test_error_in_a_profile_has_file_line_and_suggestion(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in PROFILE
    path = tmp_path / "robot.yaml"
    path.write_text(PROFILE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as error_info:
        schema.load(path, RobotProfile)
    assert message in error_info.value.what
    assert error_info.value.where.startswith(f"{path}:")
    assert error_info.value.remedy


@pytest.mark.parametrize(
    ("old", "new", "n_other_errors"),
    [
        ("rate: 5Hz", "rate: 5", 0),  # the missing item of the list is not a second error
        ("max_speed_m_s: 0.22", "max_speed_m_s: fast", 0),  # neither an integer nor a float
        ("summary: ROBOTIS", "# summary: ROBOTIS", 0),
        ("name: turtlebot3_burger\nsummary: ROBOTIS", "# summary: ROBOTIS", 1),
    ],
)
def test_each_error_is_counted_once(tmp_path: Path, old: str, new: str, n_other_errors: int) -> None:
    assert old in PROFILE
    path = tmp_path / "robot.yaml"
    path.write_text(PROFILE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as error_info:
        schema.load(path, RobotProfile)
    assert ("(and 1 more problem)" in error_info.value.what) == bool(n_other_errors), error_info.value.what


def test_error_has_the_line_of_the_key(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(PROFILE.replace("points: 360", "pionts: 360"), encoding="utf-8")
    with pytest.raises(ConfigurationError) as error_info:
        schema.load(path, RobotProfile)
    assert error_info.value.where == f"{path}:{line_of(PROFILE, 'points: 360')}"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("- record:", "- recrod:", "unknown key recrod; did you mean 'record'?"),
        ("  - record:", "  - name: up\n    record:", "unknown key name; it is a key of record: write it inside"),
        ("        - transfer: {from: sender", "        - transfer: {form: sender", "did you mean 'from'?"),
        ("- transfer: {from: sender, to: receiver", "- transfer: {from: sender, to: sender", "cannot send to itself"),
        ("- ping: {from: sender, to: receiver", "- ping: {from: sender, to: sender", "cannot ping itself"),
        ("robot: sender", "robot: boss", "there is no role boss; add a place for it"),
        ("duration: 15s", "duration: 15", "has no unit"),
        ("duration: 15s", "duration: 0s", "greater than 0"),
        ("topics: [/scan]", "topics: []", "at least 1 item"),
        ("topics: [/scan]", "topics: ['/scan; reboot']", "'/scan; reboot' is not the name of a topic"),
        (
            "topics: [/scan]",
            "topics: [scan]",
            "in steps.0.record.topics.0: 'scan' is not the name of a topic",
        ),
        (
            "into: recv.bag",
            "into: ../recv.bag",
            "'../recv.bag' is not a file name of at most 41 lower-case letters",
        ),
        ("into: recv.bag", "file: a/b/c.bag", "is not the name of a recording"),
        ("port: 1234\n", "port: 0\n", "greater than 0"),
        ("topology: master", "topology: mesh", "'mesh' is not one of: master, masterless"),
        ("repeats: 20", "repeats: 20.5", "is not a whole number"),
        ("repeats: 20", "repeats: '20'", "is not a whole number"),
        (
            "        - ping: {",
            "        - transfer: {from: sender, to: receiver}\n          ping: {",
            "a step has one kind",
        ),
    ],
)
def test_error_in_a_procedure_has_line_and_suggestion(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in PROCEDURE
    path = tmp_path / "los.yaml"
    path.write_text(PROCEDURE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as error_info:
        schema.load(path, Procedure)
    assert message in error_info.value.what
    line = int(error_info.value.where.rsplit(":", 1)[1])
    assert abs(line - line_of(PROCEDURE, old.splitlines()[0])) <= 1


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("{near: sender, away: 1m, towards: 1m}", "a place has away or towards, not both"),
        ("{near: sender}", "a place needs a distance: away, towards, left or right"),
        ("{near: other, left: 1m}", "near must be one of: sender, receiver, relay"),
    ],
)
def test_an_error_in_a_place_is_described_as_such(place: str, message: str) -> None:
    text = PROCEDURE.replace("\nsteps:", f"\nplaces: {{other: {place}}}\nsteps:", 1)
    with pytest.raises(ConfigurationError) as error_info:
        schema.validate(schema.parse(text, source="los.yaml"), Procedure)
    assert message in error_info.value.what
    assert "segment" not in str(error_info.value)


def test_bags_of_two_robots_need_different_names() -> None:
    other_recording = "\nsteps:\n  - record: {robot: relay, topics: [/scan], duration: 1s, name: NAME}"
    two_recordings = PROCEDURE.replace("\nsteps:", other_recording.replace("NAME", "theirs"), 1)
    procedure = schema.validate(schema.parse(two_recordings, source="los.yaml"), Procedure)
    recorders = [placed.step for placed in procedure.walk() if isinstance(placed.step, Records)]
    assert {role for step in recorders for role in step.records_on()} == {Role.SENDER, Role.RELAY}
    text = PROCEDURE.replace("\nsteps:", other_recording.replace("NAME", "scan"), 1)
    with pytest.raises(ConfigurationError, match=r"another step has a file scan\.bag"):
        schema.validate(schema.parse(text, source="los.yaml"), Procedure)


def test_a_transfer_without_a_file_needs_a_bag_of_its_sender() -> None:
    document = schema.parse(PROCEDURE.replace("robot: sender", "robot: receiver", 1), source="los.yaml")
    message = "the transfer from sender names no file, but no step before it records on sender"
    with pytest.raises(ConfigurationError, match=message):
        schema.validate(document, Procedure)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("receiver: b", "receiver: c", "names 'c'; the robots are: a, b"),
        ("receiver: b", "receiver: a", "one robot has two roles"),
        ("receiver: b", "reciever: b", "roles.masterless.reciever: did you mean 'receiver'?"),
        ("  a: {profile", "  A b: {profile", "'A b' cannot be a key here: 'A b' is not a name"),
        ("{profile: turtlebot3_burger}", "{profile: turtlebot3_burger, hots: x}", "did you mean 'host'?"),
    ],
)
def test_error_in_a_site_file(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        schema.validate(schema.parse(SITE.replace(old, new, 1), source="fieldkit.yaml"), Site)
    assert message in error_info.value.what


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "tx_power_dbm: 17",
            "tx_power_dbm: 17dBm",
            "'17dBm' is not a number; write it without a unit and without quotes",
        ),
        ("tx_power_dbm: 17", "tx_power_dbm: [17]", "[17] is not a number"),
    ],
)
def test_a_value_that_is_not_a_number_is_named(old: str, new: str, message: str) -> None:
    assert old in PROFILE
    with pytest.raises(ConfigurationError) as error_info:
        schema.validate(
            schema.parse(PROFILE.replace(old, new, 1), source="robots/turtlebot3_burger.yaml"), RobotProfile
        )
    assert message in error_info.value.what


def test_part_of_a_document_keeps_lines_and_path() -> None:
    document = schema.parse("a:\n  b:\n    robots: 1\n", source="x.yaml").part("a", "b")
    assert document.where(("robots",)) == "x.yaml:3"
    with pytest.raises(ConfigurationError, match=r"in a\.b\.robots: "):
        schema.validate(document, Site)


def test_missing_or_binary_file_is_an_error(tmp_path: Path) -> None:
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


def test_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(ConfigurationError) as error_info:
        load_profile("turtlebot3_burgr")
    assert "turtlebot3_burger" in error_info.value.remedy


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
def test_part_of_several_names_suggests_all(name: str, remedy: str) -> None:
    assert (
        did_you_mean(
            name, ("rtt_loss", "ip_loss", "delay_s", "cliffs_delta", "rtt_median_s", "up.topic_loss"), "look"
        )
        == remedy
    )


def test_folder_of_the_lab_takes_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    profile = PROFILE.replace("interface: wlan0", "interface: wlan7")
    (tmp_path / "robots" / "turtlebot3_burger.yaml").write_text(profile, encoding="utf-8")
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
def test_text_round_trips_even_if_it_resembles_another_type(text: str) -> None:
    model = Text(text=text)
    assert schema.validate(schema.parse(schema.dump(model), source="x"), Text) == model


class Quantities(schema.Strict):
    step: schema.Duration
    rate: schema.Bits
    size: schema.Bytes


@pytest.mark.parametrize("step", ["50us", "0.000000001s", "0s", "99999999999s"])
def test_quantities_of_any_size_round_trip(step: str) -> None:
    model = Quantities.model_validate({"step": step, "rate": "3bit/s", "size": "99GB"})
    parsed = schema.validate(schema.parse(schema.dump(model), source="x"), Quantities)
    assert parsed.model_dump_json() == model.model_dump_json()
    assert parsed.step == pytest.approx(model.step)


@pytest.mark.parametrize("model", [Tools, Payloads, RadioOptions, PhysicsOptions, PolicyChoice, EmulatedOptions])
def test_defaults_equal_those_of_an_empty_mapping(model: type[Strict]) -> None:
    assert model.defaults() == model.model_validate({})
    assert schema.dump(model.defaults()) == schema.dump(model.model_validate({}))
