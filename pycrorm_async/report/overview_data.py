"""Collect the episodes of a memory into the document of an overview: outcomes, durations, failures by reason."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import aliased

from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.query.asking.episode_list import EpisodeChoice
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.task_status import TaskStatus

_EPISODES_MAX = 20_000
"""Bounds the episodes of an overview: it then has about 5 MB."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of a description in the table."""
_REASON_MAX = 500
"""Bounds the characters of the reason for which an episode cannot be read."""
_FAILED = (TaskStatus.FAILED, TaskStatus.ERROR)


async def newest_episodes(reading: Reading, choice: EpisodeChoice | None = None) -> tuple[list[EpisodeSummary], int]:
    """Return the newest of all episodes, or of a choice, the oldest first, and the number of all of them."""
    summaries = await reading.episodes(choice)
    return summaries[-_EPISODES_MAX:], len(summaries)


async def overview_document(
    reading: Reading,
    title: str,
    episodes: Collection[EpisodeSummary],
    total: int,
    pages: Mapping[int, str],
    unreadable: Mapping[int, str],
) -> dict[str, Any]:
    """Return the document of an overview of these episodes.

    `pages` are the addresses of their pages, `unreadable` the reasons why others have none, both by number.
    """
    reasons = await _reasons(reading)
    return {
        "title": title,
        "total": total,
        "episodes": [
            {
                "number": each.number,
                "started": f"{each.started_at:%Y-%m-%d %H:%M:%S}",
                "description": each.description[:_DESCRIPTION_MAX],
                "status": each.status,
                "robots": [robot.name for robot in each.robots],
                "seconds": None if each.duration_ns is None else round(each.duration_ns / 1e9, 6),
                "nodes": each.nodes,
                "failed": each.failed,
                "reasons": reasons.get(each.number, {}),
                "page": pages.get(each.number),
                "unreadable": unreadable.get(each.number, "")[:_REASON_MAX],
            }
            for each in episodes
        ],
    }


async def _reasons(reading: Reading) -> dict[int, dict[str, int]]:
    """Count the root failures of each episode by reason: failed nodes below which no node failed."""
    below = aliased(TaskTreeNode)
    episode, reason = TaskTreeNode.process_metadata_id, TaskTreeNode.reason
    of_node = below.parent_id == TaskTreeNode.id, below.process_metadata_id == episode
    caused = select(below.id).where(*of_node, below.status.in_(_FAILED)).exists()
    counts: dict[int, dict[str, int]] = {}
    query = select(episode, reason, func.count()).where(TaskTreeNode.status.in_(_FAILED), ~caused)
    async with reading.session() as session:
        for number, name, count in await session.execute(query.group_by(episode, reason)):
            counts.setdefault(number, {})[name or "no reason"] = count
    return counts
