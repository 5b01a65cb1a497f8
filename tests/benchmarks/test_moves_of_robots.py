"""Positions and printed JSON of the benchmarks `moves` and `swarm`, without a real medium."""

import json
import os
from collections.abc import Mapping
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import moves, swarm
from fieldkit.core.model import Vector
from sim_backends.radio.radio_options import RadioOptions


@pytest.mark.parametrize("move_all", [False, True])
def test_robots_that_all_move_keep_their_distances(move_all: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    positions_m: list[Mapping[str, Vector]] = []
    medium = SimpleNamespace(
        pid=os.getpid(), attach=lambda *_: None, place=lambda places, **_: positions_m.append(dict(places))
    )
    namespace = SimpleNamespace(tun=lambda *_: os.open(os.devnull, os.O_RDONLY))
    monkeypatch.setattr(moves, "MediumClient", lambda *_, **__: nullcontext(medium))
    monkeypatch.setattr(moves, "Namespace", lambda: nullcontext(namespace))
    monkeypatch.setattr(moves, "STEPS", 3)
    moves.measure_moves("lawn", 2, RadioOptions(), move_all=move_all)
    east_m = [(places["r0"][0], places["r1"][0]) for places in positions_m]
    second_m = [5.1, 5.2, 5.3] if move_all else [5.0, 5.0, 5.0]
    assert east_m == [(0.0, 5.0), *(pytest.approx(pair) for pair in zip([0.1, 0.2, 0.3], second_m, strict=True))]


@pytest.mark.parametrize("benchmark", [moves, swarm])
def test_standard_output_is_json(
    benchmark: Any,  # noqa: ANN401 (a module)
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("measure_moves", "measure_medium", "measure_pairs", "measure_veth", "measure_startup"):
        monkeypatch.setattr(benchmark, name, lambda *_, **__: {"figure": 1.0}, raising=False)
    monkeypatch.setattr("sys.argv", ["benchmark", "--json", "--sizes", "2"])
    benchmark.main()
    output = capsys.readouterr()
    assert json.loads(output.out)
    assert "load after" in output.err
