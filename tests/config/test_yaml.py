"""YAML input: parsed as YAML 1.2 defines it, or rejected with line and remedy."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.campaign.plan import CampaignFile
from fieldkit.config import documents, schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.world.world import World
from tests.helpers.paths import DATA, ROOT


@pytest.mark.parametrize("first_item", ["ip_loss < 2 %", "[a, b]", "x: 1", "'a'"])
def test_an_item_that_is_indented_too_far_is_refused_with_its_line(first_item: str) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        documents.parse(f"expect:\n  - {first_item}\n   - rtt_loss < 5 %\n", source="p.yaml")
    assert error_info.value.where == "p.yaml:3"
    assert "indent" in error_info.value.remedy


@pytest.mark.parametrize("text", ["- a\n  -b\n", "- a - b\n", "- |\n  a\n  - b\n", "- 'a\n  - b'\n", "x: a\n  - b\n"])
def test_texts_with_dashes_are_accepted(text: str) -> None:
    documents.parse(text, source="p.yaml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("010", 10),
        ("022", 22),
        ("08", 8),
        ("-010", -10),
        ("+7", 7),
        ("9223372036854775807", 2**63 - 1),
        ("007.5", 7.5),
        (".5e3", 500.0),
        ("1_000", "1_000"),
        ("0x1F", "0x1F"),
        ("0o17", "0o17"),
        ("1:30", "1:30"),
        ("2026-11-22", "2026-11-22"),
        ("yes", "yes"),
        ("off", "off"),
        (".inf", ".inf"),
        ("NaN", "NaN"),
        ("<<", "<<"),
        ('"\\x1b"', "\x1b"),
    ],
)
def test_scalars_are_parsed_as_in_yaml_1_2(text: str, expected: object) -> None:
    value = schema.parse(f"a: {text}", source="x").data["a"]
    assert (value, type(value)) == (expected, type(expected))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("9" * 19, "beyond 9223372036854775807"),
        ("9" * 5000, "beyond 9223372036854775807"),
        ("1e999", "too large"),
        (f"0.{'1' * 5000}", "too many digits"),
        ("!!int x", "tags"),
        ("!!timestamp x", "tags"),
        ("!!bool x", "tags"),
        ("!!binary eA==", "tags"),
        ("! x", "tags"),
        ("*b", "aliases"),
        ('"\\0"', "a character that is not supported"),
        ('"\\ud800"', "a character that is not supported"),
        ('"\\U00110000"', "an escape or a directive is not valid"),
        ("\x00", "cannot contain the character 0x00"),
        ("\x7f", "cannot contain the character 0x7f"),
        ("[" * 60 + "]" * 60, "nested more than 50 deep"),
        ("[" * 100_000, "nested more than 50 deep"),
        ("{a: " * 60 + "}" * 60, "nested more than 50 deep"),
        ("{? [b] : c}", "a key must be text"),
        ("{? {} : c}", "a key must be text"),
        ("{b: 1, 'b': 2}", "duplicate key 'b'"),
        ("b: c", "mapping values are not allowed here"),
        ("\tb", "cannot start any token"),
        ("`b`", "cannot start any token"),
        ("'b", "unexpected end of stream"),
    ],
)
def test_invalid_yaml_is_rejected_with_its_line(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        schema.parse(f"# one\n\na: {text}", source="x")
    assert message in error_info.value.what
    assert error_info.value.where == "x:3"
    assert error_info.value.remedy


@pytest.mark.parametrize(
    ("data", "line", "message"),
    [
        ("a: ä".encode("utf-16"), 1, "not as UTF-16"),
        (b"a: 1\nb: \xff", 2, "save it as UTF-8"),
    ],
)
def test_other_encoding_is_rejected_with_its_line(data: bytes, line: int, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(data)
    with pytest.raises(ConfigurationError) as error_info:
        schema.read(path)
    assert (error_info.value.where, message in error_info.value.remedy) == (f"{path}:{line}", True)


def test_a_byte_order_mark_and_windows_lines_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    document = schema.read(path)
    assert (document.data, document.where(("b",))) == ({"a": 1, "b": 2}, f"{path}:2")


@pytest.mark.parametrize("path", ["/dev/zero", "/"])
def test_devices_and_folders_are_rejected(path: str) -> None:
    with pytest.raises(ConfigurationError, match="this is not a file"):
        schema.read(Path(path))


@pytest.mark.parametrize(
    ("text", "location", "message"),
    [
        ("# lab\n\nbackend: field\n", "x:3", "required key 'robots' is missing"),
        ("# lab\n\npatience: 5s\n", "x:3", "only the backend emulated has default robots and roles"),
        ("backend: field\nemulated: {}\n", "x:1", "required key 'robots' is missing"),
        ("emulated: {}\nroles: {}", "x:1", "required key 'robots' is missing"),
        ("robots: {a: {profile: x}}", "x:1", "required key 'roles' is missing"),
        ("", "x:1", "keys with values are needed here, and there are none"),
        ("robots: {a: {profile: x, host: 10}}\nroles: {}", "x:1", "put it in quotes"),
        ("robots: {a: {profile: x, port: 1_0}}\nroles: {}", "x:1", "in digits only"),
        ("robots: {a: {profile: x}}\nroles: {}\npatience: 0.2", "x:3", "write for example 0.2s or 0.2ms"),
        ("robots: {a: {profile: x}}\nroles: {}\npatience: [1]", "x:3", "a number with a unit is needed here"),
        (f"robots: {{a: {{profile: x}}}}\nroles: {{}}\npatience: {'9' * 15}s", "x:3", "too large"),
    ],
)
def test_error_in_a_site_file_has_message_and_line(text: str, location: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        schema.validate(schema.parse(text, source="x"), Site)
    assert (error_info.value.where, message in error_info.value.what) == (location, True), error_info.value


CAMPAIGN = """\
name: lawn
procedures: [los]
distances: [10ft, 20ft]
topologies: [master]
except: [{distance: 10ft}]
walk: 40m
record: 2s
seed: 7
"""
FILES: list[tuple[str, type[schema.Strict]]] = [
    *((path.read_text(encoding="utf-8"), RobotProfile) for path in sorted(ROOT.glob("robots/*.yaml"))),
    *((path.read_text(encoding="utf-8"), Procedure) for path in sorted(ROOT.glob("procedures/*.yaml"))),
    *((path.read_text(encoding="utf-8"), World) for path in sorted(ROOT.glob("sim_backends/world/*/*.yaml"))),
    *((path.read_text(encoding="utf-8"), Plan) for path in sorted(DATA.glob("fieldkit/*/trial.yaml"))[:2]),
    ((ROOT / "fieldkit/config/site_template.yaml").read_text(encoding="utf-8"), Site),
    ("radio: {loss: 10%, delay: 1ms, rate: 20Mbit/s}\nlate_bound: 100ms\nworld: open\n", EmulatedOptions),
    (CAMPAIGN, CampaignFile),
]
INVALID_VALUES = (
    *("", "~", "010", "-1", "9" * 30, "9" * 400 + "s", "1e999", ".5", "1_0", "yes", "1:30", "{}", "[]", "[1]"),
    *("''", '"\\0"', '"\\ud800"', '"\\U00110000"', "*a", "&a b", "!!int x", "|\n  x", "? a", "- a", "<<: {a: b}"),
    *(
        "0%",
        "101%",
        "1s",
        "1ft",
        "'{'",
        "'{0}'",
        "'{name:>999999999}'",
        "\t",
        "%",
        "@x",
        "\ufeff",
        "a" * 999,
        "{a: b}",
    ),
    *(
        "[" * 60,
        "{{}: a}",
        "--- x",
        "...",
        "#",
        "sender",
        "[sender, sender]",
        "master",
        "[tcp, tcp]",
        "../../etc/passwd",
    ),
)
CHARACTERS = "a01 \n\t:-?[]{},#&*!|>'\"%@`\\.~<"


def check_text(text: str, model: type[schema.Strict]) -> None:
    try:
        parsed = schema.validate(schema.parse(text, source="x.yaml"), model)
    except ConfigurationError as error:
        is_complete = error.where.startswith("x.yaml:") and error.remedy and str(error).encode()
        assert is_complete, error  # noqa: PT017 (most files are invalid, but some are valid)
    else:
        assert schema.validate(schema.parse(schema.dump(parsed), source="y.yaml"), model) == parsed


@st.composite
def damaged_files(draw: st.DrawFn) -> tuple[str, type[schema.Strict]]:
    """Return a shipped file with up to three changes, and its model."""
    text, model = draw(st.sampled_from(FILES))
    lines = text.splitlines()
    changes: tuple[Callable[[str], str], ...] = (
        lambda line: line.partition(":")[0] + ": " + draw(st.sampled_from(INVALID_VALUES)),
        lambda line: line[: draw(st.integers(0, len(line)))],
        lambda line: f"{line}\n{draw(st.sampled_from(lines))}",
        lambda line: line.replace(
            draw(st.sampled_from(line.split() or [""])), draw(st.sampled_from(INVALID_VALUES)), 1
        ),
        lambda line: draw(st.text(st.sampled_from("\0\t\r\x1b\u2028\ud800:\"'[]{}-?!&*%|>#"), max_size=3)) + line,
    )
    for _ in range(draw(st.integers(1, 3))):
        index = draw(st.integers(0, len(lines) - 1))
        lines[index] = draw(st.sampled_from(changes))(lines[index])
    return "\n".join(lines), model


TEXTS = st.text(st.characters(), max_size=40) | st.text(st.sampled_from(CHARACTERS), max_size=40)


@given(damaged_files())
def test_damaged_files_cause_only_configuration_errors(file: tuple[str, type[schema.Strict]]) -> None:
    check_text(*file)


@given(TEXTS)
@example("%YAML 1." + "9" * 5000 + "\n--- a")
@example("a: \ud800")
def test_any_text_causes_only_configuration_errors(text: str) -> None:
    check_text(text, Site)
    check_text(f"robots: {text}", Site)
