"""A document in parts: the page that is given one part after the other has the same episode as from the whole."""

import json
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pycrorm_async.query.reading import Reading
from pycrorm_async.report.document import EpisodeFold, document_behind, episode_document, read_into
from pycrorm_async.store.log import episode_named
from pycrorm_async.store.stored import StoredEvent
from tests.report.browser import Browser

pytestmark = pytest.mark.slow

SUMMARY = """
const summary = (episode) => JSON.stringify(episode, (name, value) => {
  if (value instanceof Map) return [...value];
  if (name === "episode") return null;
  if (name === "texts" || name === "head") return undefined;
  return ["parent", "children"].includes(name) ? [value].flat().map((each) => each?.start) : value;
});
"""


async def one_page(events: Sequence[StoredEvent]) -> AsyncIterator[Sequence[StoredEvent]]:
    yield events


async def parts_of(recorded: Path, number: int, step: int) -> list[dict[str, Any]]:
    """Return an episode's document in parts of so many events."""
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        log = await reading.log()
        fold = EpisodeFold(await episode_named(log, str(number)))
        parts = []
        while events := await log.events(number, after=fold.last, limit=step):
            after = fold.last
            await read_into(fold, log, one_page(events))
            parts.append(await document_behind(fold, log, after))
        return parts


@pytest.mark.soak_on("dies")
@pytest.mark.parametrize(("page", "number", "step"), [("plan", 1, 7), ("dies", 2, 1)])
async def test_parts_make_the_same_episode_as_the_whole(
    chrome: Browser, pages: dict[str, Path], recorded: Path, page: str, number: int, step: int
) -> None:
    parts = json.dumps(await parts_of(recorded, number, step))
    script = f"""
    (() => {{
      {SUMMARY}
      const parts = {parts};
      const made = new pycrormPage.episode.constructor(parts[0]);
      for (const each of parts.slice(1)) made.extend(each);
      return [summary(made), summary(pycrormPage.episode)];
    }})()"""
    with chrome.open(pages[page]) as tab:
        in_parts, whole = map(json.loads, tab.ask(script))
    assert in_parts == whole


async def test_the_part_behind_any_event_is_the_end_of_the_whole(recorded: Path) -> None:
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        log = await reading.log()
        whole = await episode_document(reading, 1)
        fold = EpisodeFold(await episode_named(log, "1"))
        await read_into(fold, log, log.pages(fold.row))
        last = whole["episode"]["last"]
        middle = await document_behind(fold, log, last // 2)
        end = await document_behind(fold, log, last)
    assert sum(middle["times"]) == sum(whole["times"])
    assert [each for each in whole["nodes"][0] if each > last // 2] == middle["nodes"][0]
    assert [len(end[name]) for name in ("times", "texts", "objects", "models", "attachments", "series")] == [0] * 6
    assert len(msgspec.json.encode(end)) < 1_500
