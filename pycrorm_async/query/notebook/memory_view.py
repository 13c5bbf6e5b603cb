"""Draw a memory: its address and the table of its newest episodes.

A notebook asks for a view while its event loop waits for the answer, so a thread with a loop of its own reads.
"""

from __future__ import annotations

import asyncio
import html
import threading

from sqlalchemy import func, select

from pycrorm_async.errors import PycrormError
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.query.asking.episode_list import EpisodeChoice
from pycrorm_async.query.named_queries import episodes
from pycrorm_async.query.notebook.episode_view import EPISODES_MAX, episodes_html
from pycrorm_async.query.notebook.markup import quiet, view
from pycrorm_async.store.address import DatabaseAddress

_ANSWER_S_MAX = 10.0
"""Bounds the wait for a database, so that a cell ends although the server does not answer."""


def memory_html(address: DatabaseAddress, located: DatabaseAddress | None) -> str:
    """Return the view of the memory at an address; it is not open if it is not `located`."""
    title = f"<b>Memory {html.escape(str(address))}</b>"
    if located is None:
        return view(f"{title} · not open", quiet("it is closed, or was never entered: await Memory.connect(url)"))
    return view(f"{title} · open", _episodes(located))


def _episodes(address: DatabaseAddress) -> str:
    answers: list[str] = []
    reader = threading.Thread(target=lambda: answers.append(asyncio.run(_read(address))), daemon=True)
    reader.start()
    reader.join(_ANSWER_S_MAX)
    return answers[0] if answers else quiet(f"the database did not answer within {_ANSWER_S_MAX:g} s")


async def _read(address: DatabaseAddress) -> str:
    from pycrorm_async.query.reading import Reading  # imports this package

    try:
        async with Reading.open_address(address) as reading, reading.session() as session:
            total = await session.scalar(select(func.count()).select_from(ProcessMetaData))
            newest = await episodes(await session.connection(), EpisodeChoice(limit=EPISODES_MAX))
            return episodes_html(newest, total or 0)
    except PycrormError as error:
        return html.escape(str(error))
