"""`fieldkit cosim table` as a user types it."""

from pathlib import Path

import pytest

from tests.e2e.test_cosim_run import cosim, rows

SHORT = ("--seeds", "1", "--set", "duration=700ms")


def test_programs_get_every_cell_with_its_verdict(tmp_path: Path) -> None:
    done = cosim(tmp_path, "table", "1", "--format", "csv", *SHORT)
    assert done.code == 0, done.err
    found = rows(done.out)
    assert len(found) == 10
    first = found[0]
    assert (first["line"], first["distance_m"], first["protocol"]) == ("los", "20", "topic")
    assert (float(first["delay_paper_s"]), float(first["loss_paper"])) == (0.01, 0)
    # Ten packets of 320 bytes by Wi-Fi.
    assert 10 * 1e-4 < float(first["delay_s"]) < 10 * 1e-3
    assert first["delay_agreement"] in {"agrees", "above", "below"}
    last = found[-1]
    assert (last["line"], last["distance_m"], last["protocol"]) == ("nlos", "100", "topic")
    assert (last["delay_s"], last["delay_agreement"]) == ("", "no value")
    assert (float(last["loss"]), last["loss_agreement"]) == (1, "above")


def test_people_get_printed_digits_and_a_count(tmp_path: Path) -> None:
    done = cosim(tmp_path, "table", "emane", "--seeds", "1", "--set", "duration=1s")
    assert done.code == 0, done.err
    assert "5.377" in done.out
    assert "54.309" in done.out
    assert max(map(len, done.out.splitlines())) <= 80
    assert "of 8 cells agree" in done.out
    assert "fieldkit docs paper" in " ".join(done.out.split())


@pytest.mark.parametrize(
    ("words", "said", "remedy"),
    [
        (("4",), "TABLE cannot be '4'", "1, 2, 3, emane, claims"),
        (("emnae",), "TABLE cannot be 'emnae'", "did you mean 'emane'?"),
        (("1", "--seeds", "0"), "must be at least 1", "--help"),
        (("1", "--set", "radio.exponant=2"), "exponant", "exponent"),
    ],
)
def test_bad_input_is_told_with_a_remedy(tmp_path: Path, words: tuple[str, ...], said: str, remedy: str) -> None:
    refused = cosim(tmp_path, "table", *words)
    assert refused.code == 2, refused.out + refused.err
    assert said in refused.err
    assert remedy in refused.err
    assert not refused.out
