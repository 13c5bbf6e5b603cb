"""`Recording` writes the episodes of any executive into a memory, from any thread and without asyncio."""

import builtins
import threading
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Self, cast, get_args
from uuid import UUID

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, EpisodeId, named_episode_id, parse_episode_id
from pycrorm_async.events.types import DesignatorTypeDeclared, NodeReference
from pycrorm_async.record import declarations
from pycrorm_async.record import opening as openings
from pycrorm_async.record.arguments import Convert
from pycrorm_async.record.declarations import RecordedKind
from pycrorm_async.record.episode_writer import Emitter, OpenEpisodes
from pycrorm_async.record.event_times import At, event_time
from pycrorm_async.record.keyed_episode import OrderedCalls
from pycrorm_async.record.recorded_before import StoredEpisodes
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.values import clean, clean_repr

_TYPES_MAX = 10_000
"""Bounds the declared types kept for reuse, which are all dropped then."""


class Recording:
    """Writes the episodes of any executive; it is `Memory.recording` and `SyncMemory.recording`.

    The hooks of our own plan layer (`plan_recorder`) open their episodes and declare their types here too.

    >>> navigate = recording.type("action", "NavigateAction", {"target_location": "pose"})
    >>> with recording.episode(description="Tutorial") as episode:
    ...     episode.start(id(task), navigate, {"target_location": Pose([1, 0, 0])})
    ...     episode.end(id(task), "FAILED", NavigationGoalNotReached())

    Args:
        known_types: the types that this memory has declared so far, shared with the recorder of our own plans.
        stored: the declarations that the database holds already, also from other processes.
        software, provenance: recorded with each episode.
        stored_episodes: the episodes of the log, to continue the one that has the `id` given to `episode`.
    """

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        known_types: declarations.KnownTypes,
        stored: Iterable[DesignatorTypeDeclared],
        *,
        software: str,
        provenance: openings.Provenance | None = None,
        stored_episodes: StoredEpisodes | None = None,
    ) -> None:
        self.emitter = emitter
        self.episodes = episodes
        self.known_types = known_types
        self._software = software
        self._provenance = provenance
        self._stored_episodes = stored_episodes
        self._calls = OrderedCalls()
        self._types: dict[tuple[object, ...], declarations.DeclaredType] = {}
        """The types declared so far, by the arguments of `type`."""
        self._lock = threading.RLock()
        for each in stored:
            known_types.note_stored(each)

    def type(
        self,
        kind: RecordedKind,
        dtype: str,
        fields: Mapping[str, declarations.FieldSpec] = MappingProxyType({}),
        *,
        bases: Sequence[str] = (),
        concept: str | None = None,
        aliases: Sequence[str] = (),
    ) -> declarations.DeclaredType:
        """Declare a type of node once, and return it; the same arguments return the same type.

        Raises nothing: a part that cannot be declared is counted as missing, with the reason. A field that contradicts
        a built-in type or an earlier declaration of this dtype is kept under `<field>_<type>`, and one with a reserved
        name, such as `kind`, under `kind_`. A type whose name cannot name a table gets a similar name; the nodes of a
        type that still cannot have a table are recorded without a type.

        Args:
            kind: an `action`; a `motion`, which moves the robot itself; `language`, which controls other nodes.
            dtype: a name as of a class. That of a built-in type (`PickUpAction`) puts the nodes into its table.
            fields: their types by name: `integer`, `real`, `text`, `boolean`, `datetime`, `enum`, `pose`, `object`,
                `("list", "real")`, `("dict", "text")`, or a Python type of these (`float`, `list[str]`, `Pose`).
            bases: dtypes of more general types, nearest first.
            concept: the SOMA concept.
            aliases: dtypes the type had before it was renamed.
        """
        try:
            further = {"bases": tuple(bases), "concept": concept, "aliases": tuple(aliases)}
            arguments = kind, dtype, tuple(fields.items()), *further.values()
            declared = self._types.get(arguments)
            if declared is None and not self.emitter.is_closed:  # first: a fork may leave the lock held
                with self._lock:
                    if len(self._types) >= _TYPES_MAX:
                        self._types.clear()
                    declared = self._types.get(arguments) or self._declare(kind, dtype, fields, **further)
                    self._types[arguments] = declared
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            declared = None
            self.emitter.note_fault("DesignatorTypeDeclared", error)
        return declared or _undeclared(kind, dtype)

    def _declare(
        self, kind: RecordedKind, dtype: str, fields: Mapping[str, declarations.FieldSpec], **further: Any
    ) -> declarations.DeclaredType:
        texts = kind, dtype, *further["bases"], *further["aliases"], further["concept"] or ""
        if not all(isinstance(each, str) for each in texts):
            raise CallerError("the kind, the dtype, the concept, the bases and the aliases of a type must be texts")
        declared = declarations.declare_named(kind, dtype, fields, self.known_types, **further)
        own, missing = declared.type, self.emitter.missing
        for name, reason in own.undeclared.items():
            missing.note(own.dtype, name, reason)
        if own.fault is not None:
            missing.note(own.dtype, "type", own.fault)
        self.emitter.put_declaration(declared)
        return own

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
        failures: openings.Failures = (),
        id: str | UUID | None = None,  # noqa: A002  the field's word
        at: At | None = None,
        created_by: str | None = None,
    ) -> RecordedEpisode:
        """Start an episode; use it with `with`, or call its `close`. Any number may be open at a time.

        An episode with an `id` is recorded once. If the log has it with its end, nothing is recorded, and `is_recorded`
        is true. A named one that an earlier process left without an end is continued: report all of it again in the
        same order; only events that are not stored yet are written.

        >>> with recording.episode(id="kitchen/2019-05-01.bag", at=1_556_700_000_000_000_000) as episode:
        ...     episode.start("a", navigate, at=1_556_700_001_500_000_000)

        Args:
            description, plan, seed, tags, metadata: as for `Memory.episode`.
            world: the description of the world in one line.
            simulated: True for a simulation, which no robot performs; ordinary queries leave it out.
            thought_by: the node that performs the simulation, from `RecordedEpisode.node_reference`.
            convert: converts each parameter, result and observed value, and each item of one, to a scalar, a text, a
                list or dict, a `PoseValue`, an `ObjectReference`, or, for a field of the type `object`, the key of an
                object. An exception that it raises is recorded as the reason why the value is missing.
            failures: the classes of the executive's own plan failures. Nodes and episodes that one left are FAILED;
                after a cancellation or Ctrl-C nodes are CANCELLED and episodes INTERRUPTED; after another exception
                both are ERROR.
            id: the UUID of the episode; or a name that no other episode has, from which the UUID is computed (UUIDv5).
                The call then blocks until all earlier records are stored and the log has been read. Until a named
                episode has an end it counts as RUNNING, also after its process died.
            at: when it started, if not now; see `event_times.At`. An event without an `at` then has the time of the
                event before it.
            created_by: who recorded it; by default the user of this process.

        Raises:
            CallerError: an argument has a wrong type or value. Any other fault is counted, and the episode stays empty.
        """
        text = description or plan or "an episode"
        unchecked: tuple[object, object] = (simulated, failures)  # as the caller passed them
        identity = None if id is None else _identity(id)
        if at is not None:
            event_time(at)
        if not isinstance(unchecked[0], bool):
            raise CallerError(f"simulated must be a bool, not {simulated!r:.100}")
        if convert is not None and not callable(convert):
            raise CallerError(f"convert must be a function, not {convert!r:.100}")
        if not isinstance(unchecked[1], tuple) or not all(isinstance(each, builtins.type) for each in unchecked[1]):
            raise CallerError(f"failures must be a tuple of classes of exceptions, not {failures!r:.100}")
        labels = openings.read_labels(tags, metadata, self.emitter.settings, self.emitter.missing)
        opening = self.opening(
            text,
            plan=plan,
            seed=seed,
            world=world,
            simulated=simulated,
            thought_by=thought_by,
            created_by=created_by,
            is_past=at is not None,
            **labels,
        )
        episode = RecordedEpisode(
            self.emitter, self.episodes, self._calls, opening, convert, failures, id=identity, at=at
        )
        if self.emitter.is_closed:
            self.emitter.note_unrecorded(f"the episode {text!r}")
        else:
            episode.open(self._stored_episodes if identity is not None else None)
        return episode

    def opening(self, description: str, **further: Any) -> openings.EpisodeOpening:
        """Return the arguments of an episode, checked; texts that are too long are cut later. Raises `CallerError`."""
        opening = openings.EpisodeOpening(description, self._software, provenance=self._provenance, **further)
        openings.check_opening(opening)
        if opening.thought_by is not None and not _is_whole(opening.thought_by):
            by = opening.thought_by
            raise CallerError(f"thought_by must be from `node_reference` of an episode, not {by!r:.100}")
        return opening

    def note_fault(self, where: str, error: BaseException) -> None:
        """Count a fault of an integration in `Memory.status`; log the 1st, 2nd, 4th, 8th and so on. Raises nothing."""
        self.emitter.note_fault(where, error)


def _identity(id: object) -> EpisodeId:  # noqa: A002  the argument's name
    if not isinstance(id, str | UUID) or not id or (isinstance(id, str) and clean(id) != id):
        raise CallerError(f"the id of an episode must be a UUID or non-empty UTF-8 text without NUL, not {id!r:.100}")
    return named_episode_id(id)


def _is_whole(reference: Any) -> bool:
    try:
        parse_episode_id(reference.episode)
        return isinstance(reference, NodeReference) and 0 < reference.node <= SEQUENCE_MAX
    except (AttributeError, TypeError, ValueError):
        return False


def _undeclared(kind: object, dtype: object) -> declarations.DeclaredType:
    """Return a type without a table, for nodes whose own type cannot be declared."""
    valid: RecordedKind = "action"
    if isinstance(kind, str) and kind in get_args(RecordedKind):
        valid = cast("RecordedKind", kind)
    return declarations.without_type(valid, clean_repr(dtype), "its type could not be declared")


# === episode block ============================================================================================
#
# An executive reports to an `EpisodeBlock`; each `with` block of it is one episode.


class EpisodeBlock:
    """Opens an episode when its block begins, and closes it when the block ends; it can be entered again after that.

    Args:
        executive: name and version of the executive, stored in the metadata of the episode.
        episode: the arguments of `Recording.episode`. A `metadata` among them replaces that of `executive`.

    Attributes:
        episode: the episode of the block; its methods record what the object has no method for.
    """

    episode: RecordedEpisode

    def __init__(self, recording: Recording, executive: str, **episode: Any) -> None:
        self._recording, self._executive = recording, executive
        self._arguments: dict[str, Any] = {"metadata": {"executive": executive}, **episode}

    def __enter__(self) -> Self:
        self.episode = self._recording.episode(**self._arguments)
        return self

    def __exit__(self, kind: object, error: BaseException | None, frames: object) -> None:
        self.episode.close(error)
