"""Make the frames of an episode: the robot's base and joints, by event or at a fixed rate, and the running action.

By event there is a frame for each event that changed the robot's state, because a plan whose motions are jumps takes a
third of a second for 70 nodes. By time there is a frame at a fixed rate, with the latest state, samples included.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.export.recorded_episode import EventTime, ExportedNode, RecordedEpisode

Clock: TypeAlias = Literal["event", "time"]
"""The axis of the frames."""

BASE = ("base.x", "base.y", "base.z", "base.qx", "base.qy", "base.qz", "base.qw")
IDLE = "idle"
"""The subtask while no action runs."""
_FRAMES_MAX = 10_000_000
"""Bounds the frames of an episode by time, because a wrong rate could fill the disk."""
_SECOND_NS = 10**9


class Frames(NamedTuple):
    """The frames of an episode.

    Attributes:
        robot: the model of the robot, or its name.
        channels: names of the numbers of a state: 7 of the base (m, quaternion), then the joints (rad, m) by name.
        states: one row for each frame.
        at: the last event of each frame; by time at the time of the frame.
        subtasks: the innermost running action of each frame, with the names of its objects.
    """

    robot: str
    channels: tuple[str, ...]
    states: NDArray[np.float32]
    at: list[EventTime]
    subtasks: list[str]


def frames_of(episode: RecordedEpisode, clock: Clock, fps: int) -> Frames:
    """Return the frames of the robot that was added first, while it was in the world.

    Raises `CallerError` for an episode without a robot, or with fewer than two frames.
    """
    robots = [identity for identity, each in episode.objects.items() if each.object_type == "ROBOT"]
    if not robots:
        raise CallerError(f"episode {episode.number} has no robot, whose states LeRobot's frames are: leave it out")
    robot = episode.objects[robots[0]]
    channels = (*BASE, *sorted(robot.joints))
    changed = list(_states(episode, robots[0], channels))
    while_there = _events_with(episode, robots[0])
    chosen = changed if clock == "event" else list(_resampled(episode.number, while_there, changed, fps))
    if len(chosen) < 2:
        stay_ns = while_there[-1].since_ns - while_there[0].since_ns
        time_remedy = f"give a higher --fps, because the robot was there for {stay_ns / 1e9:.3f} s, or --clock event"
        remedy = time_remedy if clock == "time" else "leave it out"
        count = f"{len(chosen)} frame{'' if len(chosen) == 1 else 's'}"
        raise CallerError(f"episode {episode.number} has {count} by {clock}, and LeRobot needs two: {remedy}")
    at = [when for when, _ in chosen]
    states = np.array([state for _, state in chosen], dtype=np.float32)
    return Frames(robot.model or robot.name, channels, states, at, list(_subtasks(episode.nodes, at)))


def _states(
    episode: RecordedEpisode, identity: int, channels: Sequence[str]
) -> Iterator[tuple[EventTime, tuple[float, ...]]]:
    """Yield each event that changed the robot's state, and the state after it."""
    index = {name: position for position, name in enumerate(channels)}
    state = [0.0] * len(channels)
    before: tuple[float, ...] | None = None
    for change in episode.changes:
        if change.object != identity:
            continue
        if change.removed:
            return
        if change.pose is not None:
            state[: len(BASE)] = change.pose
        for name, position in change.joints.items():
            if name in index:
                state[index[name]] = position
        now = tuple(state)
        if now != before:
            before = now
            yield change.when, now


def _events_with(episode: RecordedEpisode, identity: int) -> list[EventTime]:
    """Return the events from the one that added the robot to the last one before its removal."""
    removals = (each.when.sequence for each in episode.changes if each.removed and each.object == identity)
    removal = next(removals, None)
    return [each for each in episode.events if identity <= each.sequence and (not removal or each.sequence < removal)]


def _resampled(
    episode: int, events: Sequence[EventTime], changed: Sequence[tuple[EventTime, tuple[float, ...]]], fps: int
) -> Iterator[tuple[EventTime, tuple[float, ...]]]:
    """Yield the last event and the state in force at each multiple of 1 / fps, from the first event to the last."""
    begin_ns, end_ns = events[0].since_ns, events[-1].since_ns
    count = (end_ns - begin_ns) * fps // _SECOND_NS + 1
    if count > _FRAMES_MAX:
        raise CallerError(f"episode {episode} would have {count:,} frames at {fps} per second: give a lower --fps")
    event = state = 0
    for frame in range(count):
        since_ns = begin_ns + frame * _SECOND_NS // fps
        while event + 1 < len(events) and events[event + 1].since_ns <= since_ns:
            event += 1
        while state + 1 < len(changed) and changed[state + 1][0].sequence <= events[event].sequence:
            state += 1
        yield events[event]._replace(since_ns=since_ns), changed[state][1]


def _subtasks(nodes: Sequence[ExportedNode], at: Sequence[EventTime]) -> Iterator[str]:
    """Yield the label of the action that was running last at each of these events."""
    actions = [each for each in nodes if each.kind == "action"]
    running: list[tuple[int, ExportedNode]] = []  # the one that started last comes first
    started = 0
    for when in at:
        while started < len(actions) and actions[started].sequence <= when.sequence:
            heapq.heappush(running, (-actions[started].sequence, actions[started]))
            started += 1
        while running and (end := running[0][1].end) is not None and end.sequence <= when.sequence:
            heapq.heappop(running)
        yield running[0][1].label if running else IDLE
