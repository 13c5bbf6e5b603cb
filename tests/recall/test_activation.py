"""The activation is near that of ACT-R, and what falls below a threshold is counted before anything is hidden."""

from __future__ import annotations

import random

import numpy as np
import pytest

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall import search as activations
from pycrorm_async.recall.blocks import Block, CaseLibrary
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.search import activation, forgotten

NOW_US = 10_000_000_000


def test_up_to_three_uses_are_counted_exactly_and_more_nearly() -> None:
    assert activation(np.array([4.0])) == pytest.approx(np.log(0.5))
    assert activation(np.array([1.0, 4.0, 100.0])) == pytest.approx(np.log(1.6))
    assert activation(np.array([0.0])) < 4, "an action that starts now does not outweigh all others"
    assert activation(np.full(10, 4.0)) == pytest.approx(np.log(5))
    chance = np.random.default_rng(1)
    for size in (4, 20, 300):
        ages = np.sort(chance.uniform(1, 10_000, size))
        assert activation(ages) == pytest.approx(float(np.log(np.sum(ages**-0.5))), abs=0.15)


def use(sequence: int, age_s: float, arm: str, name: str = "A") -> Case:
    texts: dict[str, str | tuple[str, ...]] = {"arm": arm, "near": ("CUP",) if sequence % 2 else ("BOWL",)}
    status = "FAILED" if sequence % 3 else "SUCCEEDED"
    return Case(row_id(1, sequence, 0), NOW_US - round(age_s * 1e6), name, texts, {"x": age_s}, status, None, 1.0)


@pytest.mark.parametrize("numbers_max", [2**62, 3])
def test_all_cases_of_a_way_have_its_activation(numbers_max: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activations, "_NUMBERS_MAX", numbers_max)
    chance = random.Random(2)
    cases = [use(n, chance.uniform(1, 9_000), chance.choice("LR"), chance.choice("AB")) for n in range(1, 200)]
    library = CaseLibrary([Block.of(cases[:50]), Block.of(cases[50:])])

    def hidden(threshold: float) -> set[int]:
        return set(forgotten(library, threshold=threshold, now_us=NOW_US).nodes.tolist())

    for name in "AB":
        for arm in "LR":
            way = [case for case in cases if (case.type, case.symbols["arm"]) == (name, arm)]
            ages = np.sort([(NOW_US - case.started_us) / 1e6 for case in way])
            nodes, value = {case.node for case in way}, activation(ages)
            assert nodes <= hidden(value + 1e-9)
            assert not nodes & hidden(value - 1e-9)


def test_what_is_forgotten_is_what_lies_below_the_threshold() -> None:
    cases = [use(1, 1.0, "L"), use(2, 2.0, "L"), use(3, 9_000.0, "R"), use(4, 8_000.0, "R"), use(5, 9_000.0, "L")]
    library = CaseLibrary([Block.of(cases)])
    hidden = forgotten(library, threshold=-2.0, now_us=NOW_US)
    assert (hidden.cases, hidden.ways) == (2, 1)
    assert hidden.nodes.tolist() == [cases[2].node, cases[3].node]
    assert forgotten(library, threshold=-99.0, now_us=NOW_US).cases == 0
    assert forgotten(library, threshold=99.0, now_us=NOW_US)[:2] == (5, 2)
    assert forgotten(CaseLibrary(), threshold=99.0, now_us=NOW_US)[:2] == (0, 0)
