"""Choose episodes by status, start, tags, robot, text: for `memory.ask.episodes`, `pycrorm episodes` and reports."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import ColumnElement, Select, exists, or_, select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import EpisodeRobot, EpisodeTag, ProcessMetaData
from pycrorm_async.query.asking.columns import EpisodeNumber, check_texts, containing, limited, member_of, of_episode
from pycrorm_async.task_status import TaskStatus


@dataclass(frozen=True)
class EpisodeChoice:
    """Conditions on episodes; None means no condition.

    Attributes:
        status: the name of a `TaskStatus`.
        since: the earliest start, with a time zone.
        tags: an episode has all of them.
        robot: name or model of a robot that took part.
        text: a part of the description, the plan's name or a tag.
        limit: the largest number of episodes; the newest that fulfil all conditions are taken.
    """

    status: str | None = None
    since: datetime | None = None
    tags: tuple[str, ...] = ()
    robot: str | None = None
    text: str | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        check_texts({"status": self.status, "robot": self.robot, "text": self.text})
        for each in self.tags:
            check_texts({"tag": each})
        if self.since is not None and not isinstance(self.since, datetime):
            raise CallerError(f"since must be a datetime with a time zone, got {self.since!r}")
        if self.since is not None and self.since.tzinfo is None:
            raise CallerError(f"since has no time zone: {self.since.isoformat()}")
        # Both are built again for each query; here they raise where the choice is made.
        self.conditions()
        limited(select(), self.limit)

    def __str__(self) -> str:
        """Return the conditions as `status FAILED; tags night, kitchen; the newest 10`; empty if there is none."""
        conditions = {
            "status": self.status,
            "since": None if self.since is None else f"{self.since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC",
            "tags" if len(self.tags) > 1 else "tag": ", ".join(self.tags) or None,
            "robot": self.robot,
            "text": self.text,
            "the newest": self.limit,
        }
        return "; ".join(f"{name} {value}" for name, value in conditions.items() if value is not None)

    def conditions(self) -> list[ColumnElement[bool]]:
        """Return the conditions on `ProcessMetaData`, without the limit. Raises `CallerError` for a wrong status."""
        episode, conditions = ProcessMetaData, []
        if self.status is not None:
            conditions.append(episode.status == member_of(TaskStatus, self.status, "status"))
        if self.since is not None:
            conditions.append(episode.created_at >= self.since)
        conditions += [
            exists().where(EpisodeTag.process_metadata_id == episode.id, EpisodeTag.tag == each) for each in self.tags
        ]
        if self.robot is not None:
            robot = EpisodeRobot
            named = or_(robot.name == self.robot, robot.model == self.robot)
            conditions.append(exists().where(robot.process_metadata_id == episode.id, named))
        if self.text is not None:
            tagged = exists().where(EpisodeTag.process_metadata_id == episode.id, containing(self.text, EpisodeTag.tag))
            conditions.append(or_(containing(self.text, episode.description, episode.plan), tagged))
        return conditions

    def newest(self) -> Select[*tuple[int]]:
        """Return the select of the numbers of the chosen episodes."""
        return limited(
            select(ProcessMetaData.id).where(*self.conditions()).order_by(ProcessMetaData.id.desc()), self.limit
        )


def episode_list(episode: EpisodeNumber | None, choice: EpisodeChoice) -> Select[*tuple[Any, ...]]:
    """Select the chosen episodes with their outcomes, the newest first."""
    listed = ProcessMetaData
    statement = select(
        listed.id.label("episode"),
        listed.uuid.label("id"),
        listed.created_at.label("started_at"),
        listed.ended_at,
        listed.status,
        listed.description,
        listed.plan,
        listed.created_by,
        listed.world,
        listed.failure_type,
        listed.failure_message,
        listed.continues,
    )
    if episode is not None:
        statement = statement.where(of_episode(listed.id, episode))
    return limited(statement.where(*choice.conditions()).order_by(listed.id.desc()), choice.limit)
