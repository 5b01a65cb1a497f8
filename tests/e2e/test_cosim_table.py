"""`fieldkit cosim table` on the command line."""

from pathlib import Path

import pytest

from tests.e2e.test_cosim_run import cosim, rows

SHORT = ("--seeds", "1", "--set", "duration=700ms")


def test_csv_contains_every_cell_with_its_verdict(tmp_path: Path) -> None:
    run = cosim(tmp_path, "table", "1", "--format", "csv", *SHORT)
    assert run.code == 0, run.err
    cells = rows(run.out)
    assert len(cells) == 10
    first = cells[0]
    assert (first["line"], first["distance_m"], first["protocol"]) == ("los", "20", "topic")
    assert (float(first["delay_paper_s"]), float(first["loss_paper"])) == (0.01, 0)
    # The delay of ten packets of 320 bytes over Wi-Fi.
    assert 10 * 1e-4 < float(first["delay_s"]) < 10 * 1e-3
    assert first["delay_agreement"] in {"agrees", "above", "below"}
    last = cells[-1]
    assert (last["line"], last["distance_m"], last["protocol"]) == ("nlos", "100", "topic")
    assert (last["delay_s"], last["delay_agreement"]) == ("", "no value")
    assert (float(last["loss"]), last["loss_agreement"]) == (1, "above")


def test_the_text_table_has_the_digits_of_the_paper_and_a_count(tmp_path: Path) -> None:
    run = cosim(tmp_path, "table", "emane", "--seeds", "1", "--set", "duration=1s")
    assert run.code == 0, run.err
    assert "5.377" in run.out
    assert "54.309" in run.out
    assert max(map(len, run.out.splitlines())) <= 80
    assert "of 8 cells agree" in run.out
    assert "fieldkit docs paper" in " ".join(run.out.split())


@pytest.mark.parametrize(
    ("words", "message", "remedy"),
    [
        (("4",), "TABLE cannot be '4'", "1, 2, 3, emane, claims"),
        (("emnae",), "TABLE cannot be 'emnae'", "did you mean 'emane'?"),
        (("1", "--seeds", "0"), "must be at least 1", "--help"),
        (("1", "--set", "radio.exponant=2"), "exponant", "exponent"),
    ],
)
def test_bad_input_is_reported_with_a_remedy(
    tmp_path: Path, words: tuple[str, ...], message: str, remedy: str
) -> None:
    rejected_run = cosim(tmp_path, "table", *words)
    assert rejected_run.code == 2, rejected_run.out + rejected_run.err
    assert message in rejected_run.err
    assert remedy in rejected_run.err
    assert not rejected_run.out
