"""`Recording` is how any executive writes episodes into a memory, from any thread and without asyncio."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.events.values import NodeReference
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.declarations.known_types import KnownTypes
from pycrorm_async.recording.declarations.recorded_type import FieldSpec, RecordedKind, declare_type
from pycrorm_async.recording.recorded_episode import RecordedEpisode
from pycrorm_async.recording.recorded_values import Convert
from pycrorm_async.recording.values.episode_arguments import check_arguments, read_labels
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening
from pycrorm_async.recording.writing.open_episodes import OpenEpisodes
from pycrorm_async.recording.writing.provenance import Provenance

__all__ = ["Recording"]


class Recording:
    """Writes the episodes of an executive that is not ours; `Memory.recording` and `SyncMemory.recording`.

    >>> navigate = recording.type("action", "NavigateAction", {"target_location": "pose"})
    >>> with recording.episode(description="Tutorial") as episode:
    ...     episode.start(id(task), navigate, {"target_location": Pose([1, 0, 0])})
    ...     episode.end(id(task), "FAILED", NavigationGoalNotReached())
    """

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        known: KnownTypes,
        *,
        software: str,
        provenance: Provenance | None = None,
    ) -> None:
        self._emitter = emitter
        self._episodes = episodes
        self._known = known
        self._software = software
        self._provenance = provenance
        self._types: dict[Hashable, DeclaredType] = {}
        self._lock = threading.RLock()

    def type(
        self,
        kind: RecordedKind,
        dtype: str,
        fields: Mapping[str, FieldSpec] = MappingProxyType({}),
        *,
        bases: Sequence[str] = (),
        concept: str | None = None,
        aliases: Sequence[str] = (),
    ) -> DeclaredType:
        """Declare a type of node once, and return it; the same arguments return the same type.

        What cannot be declared is counted as missing, with the reason, and never raises. A field that contradicts a
        built-in type or an earlier declaration of this dtype is kept under `<field>_<type>`. A type whose name cannot
        be a table's gets a similar one; the nodes of a type that still cannot have a table are recorded without a type.

        Args:
            kind: an `action`; a `motion`, which moves the robot itself; `language`, which controls other nodes.
            dtype: a name as of a class. With the dtype of a built-in type (`PickUpAction`), nodes are in its table.
            fields: their types by name: `integer`, `real`, `text`, `boolean`, `datetime`, `enum`, `pose`, `object`,
                `("list", "real")`, `("dict", "text")`, or a Python type of these (`float`, `list[str]`, `Pose`).
            bases: dtypes of more general types, nearest first.
            concept: the SOMA concept.
            aliases: dtypes the type had before it was renamed.
        """
        cached = (kind, dtype, tuple(fields.items()), tuple(bases), concept, tuple(aliases))
        with self._lock:
            declared = self._types.get(cached)
            if declared is None:
                declared = self._types[cached] = self._declare(kind, dtype, fields, bases, concept, aliases)
        return declared

    def _declare(
        self,
        kind: RecordedKind,
        dtype: str,
        fields: Mapping[str, FieldSpec],
        bases: Sequence[str],
        concept: str | None,
        aliases: Sequence[str],
    ) -> DeclaredType:
        made = declare_type(kind, dtype, fields, self._known, bases=bases, concept=concept, aliases=aliases)
        declared, missing = made.type, self._emitter.missing
        for name, renamed in made.fields.items():
            missing.note_renamed(declared.dtype, name, *renamed)
        for each in declared.undeclared:
            missing.note(declared.dtype, each.name, each.reason)
        if made.dtype is not None:
            missing.note_renamed(declared.dtype, "type", *made.dtype)
        if declared.fault is not None:
            missing.note(declared.dtype, "type", declared.fault)
        if declared.payload and not self._emitter.is_closed:
            try:
                self._emitter.put_declaration(declared)
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                self._emitter.note_fault("DesignatorTypeDeclared", error)
        return declared

    def episode(
        self,
        *,
        description: str | None = None,
        plan: str | None = None,
        seed: int | None = None,
        tags: Sequence[str] = (),
        metadata: Mapping[str, Any] = MappingProxyType({}),
        world: str | None = None,
        simulated: bool = False,
        thought_by: NodeReference | None = None,
        convert: Convert | None = None,
    ) -> RecordedEpisode:
        """Start an episode; use it with `with`, or call its `close`. Any number may be open at a time.

        Args:
            description, plan, seed, tags, metadata: as for `Memory.episode`.
            world: the description of the world in one line.
            simulated: whether the robot only imagines it; ordinary queries leave such an episode out.
            thought_by: the node that imagines it, from `RecordedEpisode.node_reference`.
            convert: converts each parameter, result and observed value, and each item of one, to a scalar, a text, a
                list or dict, a `PoseValue`, an `ObjectReference`, or the key of an object. What it raises is recorded
                as the reason why the value is missing.

        Raises:
            CallerError: an argument has the wrong type. What else goes wrong is counted, and the episode stays empty.
        """
        text = description or plan or "an episode"
        check_arguments(description=text, plan=plan, seed=seed, strict=False)
        check_arguments(description=world, plan=None, seed=None, strict=False)
        if convert is not None and not callable(convert):
            raise CallerError(f"convert must be a function, not {convert!r:.100}")
        opening = EpisodeOpening(
            text,
            self._software,
            plan,
            seed,
            world,
            simulated=simulated,
            thought_by=thought_by,
            provenance=self._provenance,
            labels=read_labels(tags, metadata, self._emitter),
        )
        episode = RecordedEpisode(self._emitter, self._episodes, opening, convert)
        if self._emitter.is_closed:
            return episode
        try:
            episode.open()
            self._episodes.add(episode)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("EpisodeStarted", error)
            episode.closed = True
        return episode

    def note_fault(self, where: str, error: BaseException) -> None:
        """Count a fault of an integration in `Memory.status`, and log it now and then. Raises nothing."""
        self._emitter.note_fault(where, error)
