"""Scripts of events, one second apart, at known times; and the log and tables of a memory, made from records."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pycrorm_async.events.codec import Record, encode, fingerprint, short_name
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    FieldDeclared,
    FieldType,
    Happening,
    ItemType,
    NodeKind,
    PoseValue,
)
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import StoredEvent

# === event script =============================================================================================
#
# A script of events: an episode is a list of events, one second apart, at known times.

T0_NS = 1_700_000_000_000_000_000
"""2023-11-14 22:13:20 UTC: event n of an episode happens n seconds later."""
T0_US = T0_NS // 1000


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, turned: float = 0.0) -> PoseValue:
    """Return a pose made a millisecond and 7 ns before T0; `turned` is its quaternion's z, with a matching w."""
    return PoseValue((x, y, z), (0.0, 0.0, turned, (1 - turned**2) ** 0.5), "map", T0_NS - 1_000_007)


POSE_US = T0_US - 1001


def field(
    name: str, type_: FieldType, slot: int, *, item: ItemType | None = None, optional: bool = False
) -> FieldDeclared:
    column = f"{name}_id" if type_ in ("pose", "object") else name
    return FieldDeclared(name=name, column=column, type=type_, slot=slot, item=item, optional=optional)


def declared(
    dtype: str,
    table: str,
    *fields: FieldDeclared,
    kind: NodeKind = "action",
    bases: tuple[str, ...] = (),
) -> DesignatorTypeDeclared:
    return DesignatorTypeDeclared(kind=kind, dtype=dtype, table=table, bases=bases, fields=fields)


NAVIGATE = declared("NavigateAction", "navigate_action", field("target_location", "pose", 2))
PICK_UP = declared(
    "PickUpAction",
    "pick_up_action",
    field("object_designator", "object", 2),
    field("arm", "enum", 3),
    field("grasp", "enum", 4),
)
MOVE = declared("MoveMotion", "move_motion", field("target", "pose", 2), kind="motion")
SAYING = declared("SayingAction", "saying_action", field("text", "text", 2))


def name_of(declaration: DesignatorTypeDeclared) -> str:
    """The name of a designator type that a NodeStarted event carries."""
    return short_name(fingerprint(encode(declaration)))


class Script:
    """Collect the events of one episode. `put` returns the event's sequence, as a queue would."""

    def __init__(self, episode: int = 1) -> None:
        self.episode = EpisodeId(bytes([0, 0, 0, 0, 0, 0, 0x70, 0, 0x80, 0, 0, 0, 0, *episode.to_bytes(3)]))
        self.records: list[Record] = []

    def put(self, event: Happening, *, version: int | None = None) -> int:
        return self.put_payload(type(event).__name__, encode(event), version or event.version)

    def put_payload(self, type_: str, payload: bytes, version: int = 1) -> int:
        sequence = len(self.records) + 1
        wall_ns, monotonic_ns = T0_NS + sequence * 10**9, sequence * 10**9 + 5
        self.records.append(Record(sequence, self.episode, sequence, type_, version, wall_ns, monotonic_ns, payload))
        return sequence

    def stored(self, number: int = 1) -> list[StoredEvent]:
        """The events as a log returns them."""
        return [
            StoredEvent(number, each.sequence, each.type, each.version, each.wall_ns, each.monotonic_ns, each.payload)
            for each in self.records
        ]


def declarations(*types: DesignatorTypeDeclared) -> list[Record]:
    """The records that belong to the recorder and to no episode."""
    return [
        Record(position, None, 0, "DesignatorTypeDeclared", 1, T0_NS, 0, encode(each))
        for position, each in enumerate(types, 1)
    ]


def time_us(sequence: int) -> int:
    """The time of an event."""
    return T0_US + sequence * 1_000_000


def row(sequence: int, slot: int = 0, *, number: int = 1) -> int:
    """Return the expected id of a row: 22 bits of episode, 26 of sequence, 5 of slot."""
    return number * 2**31 + sequence * 2**5 + slot


def mixed(*scripts: Script) -> Sequence[Record]:
    """Interleave the records of several episodes, one of each in turn."""
    longest = max(len(each.records) for each in scripts)
    return [each.records[index] for index in range(longest) for each in scripts if index < len(each.records)]


# === factories ================================================================================================
#
# Make the log of a memory at a URL, with its tables, from records.


async def append_and_fold(url: str, records: Iterable[Record], *, folded: bool = True) -> None:
    """Append to a log that is opened for this call alone, and fold it unless `folded` is false; none is refused."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    try:
        assert await log.append(list(records)) == {}
        if folded:
            projector = Projector(log)
            await projector.open()
            await projector.catch_up()
    finally:
        await log.close()
