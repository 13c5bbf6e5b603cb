"""Query the episodes that run, and the robots of episodes, without the mapped classes.

`pycrorm status` asks nothing else of the tables, and mapping the classes would take half of its time.
"""

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import BigInteger, column, func, select, table
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.clock import utc_of
from pycrorm_async.task_status import TaskStatus

_episode = table("process_metadata", *(column(name) for name in ("id", "uuid", "created_at", "description", "status")))
_robot = table(
    "episode_robot",
    column("id", BigInteger()),
    column("process_metadata_id", BigInteger()),
    *(column(name) for name in ("name", "model", "serial", "description_fingerprint")),
)


@dataclass(frozen=True)
class RobotSummary:
    """A robot that took part in an episode.

    Attributes:
        name: of its object in the world.
        model, serial: of its `RobotDescription`; None if there is none, and in episodes of version 0.1.0.
        description: fingerprint of its recorded description; None likewise.
    """

    name: str
    model: str | None
    serial: str | None
    description: str | None

    def __str__(self) -> str:
        """Return the name, with model and serial as far as they add to it."""
        model = " ".join(each for each in (self.model, self.serial) if each is not None)
        return f"{self.name} ({model})" if model not in ("", self.name) else self.name


@dataclass(frozen=True)
class RunningEpisode:
    """An episode that has not ended, as far as the tables show it, and the robots that took part so far."""

    number: int
    id: str
    started_at: datetime
    description: str
    robots: tuple[RobotSummary, ...]


async def running_episodes(connection: AsyncConnection, limit: int) -> tuple[list[RunningEpisode], int]:
    """Return the running episodes that started last, at most `limit`, the newest first; and the number of all."""
    own = _episode.c
    query = select(own.id, own.uuid, own.created_at, own.description, func.count().over().label("total"))
    query = query.where(own.status == TaskStatus.RUNNING.name).order_by(own.id.desc()).limit(limit)
    rows = (await connection.execute(query)).all()
    robots = await robots_of(connection, [each.id for each in rows])
    episodes = [
        RunningEpisode(each.id, each.uuid, utc_of(each.created_at), each.description, tuple(robots.get(each.id, ())))
        for each in rows
    ]
    return episodes, rows[0].total if rows else 0


async def robots_of(connection: AsyncConnection, numbers: Collection[int]) -> dict[int, list[RobotSummary]]:
    """Return the robots of the episodes with these numbers, by episode."""
    query = select(_robot).where(_robot.c.process_metadata_id.in_(numbers)).order_by(_robot.c.id)
    robots: dict[int, list[RobotSummary]] = {}
    for row in await connection.execute(query):
        summary = RobotSummary(row.name, row.model, row.serial, row.description_fingerprint)
        robots.setdefault(row.process_metadata_id, []).append(summary)
    return robots
