"""An outage of the database is reported once when it has lasted a second, and so is its end."""

import asyncio

import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.writer.daemon import Availability


class Observed:
    """A database whose calls take a given time by a clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.reports: list[str | float] = []
        self.availability = Availability(
            now_s=lambda: self.now_s, on_lost=self.reports.append, on_back=self.reports.append
        )

    async def call(self, *, takes_s: float = 0.0, fails: bool = False) -> int:
        async def answer() -> int:
            self.now_s += takes_s
            if fails:
                raise DatabaseUnavailable(f"away at {self.now_s:g} s")
            return 7

        return await self.availability.observe(answer())

    async def fail(self, *, takes_s: float = 0.0) -> None:
        with pytest.raises(DatabaseUnavailable):
            await self.call(takes_s=takes_s, fails=True)


async def test_an_outage_shorter_than_a_second_is_not_reported() -> None:
    observed = Observed()
    await observed.fail(takes_s=0.5)
    await observed.fail(takes_s=0.4)
    assert await observed.call() == 7
    await observed.fail(takes_s=0.9)  # another outage
    assert observed.reports == []


async def test_a_longer_outage_and_its_end_are_reported_once() -> None:
    observed = Observed()
    for _ in range(3):
        await observed.fail(takes_s=0.6)
    observed.now_s = 5.0
    assert await observed.call() == 7
    assert await observed.call() == 7
    assert observed.reports == ["away at 1.2 s", 5.0]
    await observed.fail(takes_s=2.0)
    assert observed.reports[2:] == ["away at 7 s"]


async def test_an_answer_to_a_call_from_before_the_outage_does_not_end_it() -> None:
    observed = Observed()
    answered = asyncio.Event()

    async def answer_late() -> None:
        await answered.wait()

    early = asyncio.create_task(observed.availability.observe(answer_late()))
    await asyncio.sleep(0)
    observed.now_s = 1.0
    await observed.fail(takes_s=2.0)
    answered.set()
    await early
    assert observed.reports == ["away at 3 s"]
    assert await observed.call() == 7
    assert observed.reports == ["away at 3 s", 2.0]
