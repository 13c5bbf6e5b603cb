"""A question about one episode costs the same among few episodes and among many.

The work is counted, because CPU time depends on what else the machine does: on SQLite the steps of its virtual machine,
in hundreds, on PostgreSQL the rows that all steps of all plans read. `python -m bench.one_episode` measures the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from bench.one_episode import WRITING, Steps, fill, questions_of, rows_read
from pycrorm_async.projections import pipeline
from tests.databases import Server, ask_to_change, put_memory, run_in_own_loop

FEW = 50
OF_ALL = {"sqlite": {"list"}, "postgresql": {"list", "copy in", "recall", *WRITING}}
"""A list has many episodes. On PostgreSQL the fold of recall looks at the checkpoint of each one, a recall reads the
numbers of up to 15 blocks of each level, and the rows that a writing statement reads cannot be counted."""
RATIO_MAX = 1.5
SLACK = 10
"""Units of work that a deeper index may cost."""


@pytest.fixture(params=["sqlite", "postgresql"])
def few_and_many(request: pytest.FixtureRequest, many: int, tmp_path: Path) -> Iterator[dict[int, str]]:
    """The URLs of two memories, by their number of episodes."""
    sizes = (FEW, many)
    with ExitStack() as stack:
        if request.param == "sqlite":
            urls = {size: put_memory(tmp_path / f"{size}.db") for size in sizes}
        else:
            server: Server = request.getfixturevalue("server")
            urls = {size: server.new_memory() for size in sizes}
            for url in urls.values():
                stack.callback(server.drop_soon, url)
        for size, url in urls.items():
            run_in_own_loop(fill(url, size))
            if request.param == "postgresql":
                ask_to_change(url, "ANALYZE")  # as a server does by itself within a minute
        yield urls


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    "many", [pytest.param(1_500, marks=pytest.mark.slow), pytest.param(5_000, marks=pytest.mark.soak)]
)
async def test_a_question_about_one_episode_costs_the_same_however_many_episodes_there_are(
    few_and_many: dict[int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "_UNMARKED_EVENTS_MIN", 100)  # as among more episodes, of which so many are few
    work: dict[str, list[int]] = {}
    for size, url in few_and_many.items():
        folder = tmp_path / f"files of {size}"
        folder.mkdir()
        with Steps() as steps:
            async with questions_of(url, size // 2, folder) as questions:
                for name, question in questions.items():
                    if name in OF_ALL[url.partition(":")[0].partition("+")[0]]:
                        continue
                    await question()  # the first time it may learn declarations
                    if url.startswith("postgresql"):
                        work.setdefault(name, []).append(await rows_read(url, question))
                        continue
                    before = steps.hundreds
                    await question()
                    work.setdefault(name, []).append(steps.hundreds - before)
    assert len(work) > 20
    grown = {name: (few, many) for name, (few, many) in work.items() if many > RATIO_MAX * few + SLACK}
    assert grown == {}
