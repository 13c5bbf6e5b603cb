"""Random cases whose values are few, so that cues meet them, with every kind of column and every absence."""

from __future__ import annotations

import random

from hypothesis import strategies as st

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall.columns import Case

__all__ = ["CASES", "random_case", "random_cases"]

TYPES = ("PickUpAction", "PlaceAction", "NavigateAction")
WORDS = ("MILK", "BOWL", "CUP", "SPOON")
STATUSES = ("SUCCEEDED", "FAILED", "ERROR", "LOST")


def random_case(sequence: int, chance: random.Random, *, words: tuple[str, ...] = WORDS) -> Case:
    """One case; its start differs from those of others in some tries only, and it may lack any feature."""

    def some(value: object) -> bool:
        return value is not None and chance.random() < 0.8

    texts = {
        "object_type": chance.choice(words),
        "arm": chance.choice(("LEFT", "RIGHT")),
        "near": tuple(sorted(chance.sample(words, chance.randrange(len(words))))),
    }
    numbers = {
        "height": round(chance.uniform(0.5, 1.5), 2),
        "stand_yaw": chance.uniform(-3.14, 3.14),
        "ticket": chance.choice((3.0, 2.0**40 + 1)),
    }
    status = chance.choice(STATUSES)
    episode = chance.randrange(1, 4)
    return Case(
        row_id(episode, sequence, 0),
        chance.randrange(50),
        chance.choice(TYPES),
        {name: value for name, value in texts.items() if value and some(value)},
        {name: value for name, value in numbers.items() if some(value)},
        status,
        chance.choice(("IKError", "ObjectUnreachable")) if status == "FAILED" else None,
        None if status == "LOST" else chance.random(),
        row_id(episode, 7, 0) if chance.random() < 0.3 else None,
        chance.random() < 0.1,
    )


def random_cases(count: int, seed: int, *, words: tuple[str, ...] = WORDS) -> list[Case]:
    """Return cases with different nodes."""
    chance = random.Random(seed)
    return [random_case(sequence, chance, words=words) for sequence in range(1, count + 1)]


CASES = st.builds(random_cases, st.integers(1, 40), st.integers(0, 2**32))
"""Lists of random cases."""
