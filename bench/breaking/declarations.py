"""Declarations of other programs: good types among hostile ones, written straight into the log by the append port."""

from __future__ import annotations

import asyncio
import random
import string
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.events.codec import declaration_of, encode, fingerprint
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.fields import column_name, table_name
from pycrorm_async.events.ids import episode_text
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    FieldDeclared,
    NodeEnded,
    NodeStarted,
)
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask
from tests.projections.event_script import T0_NS, Script

__all__ = ["foreign_declarations"]

_NAMES = "xmin xmax cmin cmax ctid tableoid true FALSE select order rowid oid null user größe".split()
_CRAFTED = (
    *"ID pose object node metadata dtype x%s a:b a.b '' \" _hidden __init__ pose__7".split(),
    "a\0b",
    "x" * 5_000,
    "",
    " ",
)
_DTYPES = ("Pose", "Pose__7", "Evil Action", "E" * 400, "PickUpAction", "a\0b", "", "SimulatedEpisode")
_NO_DECLARATIONS = (b"[]", b"{", b"5", b'{"kind":"action"}', b'"\\u0000"', b"no JSON")


def foreign_declarations(new: Callable[[Path], str]) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Each round a memory of its own: all that good types recorded must be in its tables, live and rebuilt."""

    def broken(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome()
        parked = 0
        for number in range(rounds):
            place = folder / str(number)
            place.mkdir()
            parked += asyncio.run(_round(new(place), rng, outcome))
            step()
        outcome.note = f"{parked} episodes of hostile types parked with a reason"
        return outcome

    return broken


async def _round(url: str, rng: random.Random, outcome: Outcome) -> int:
    """Episodes of good and hostile types in random order; how many were parked."""
    good = [*_good(rng)]
    episodes = [*good, *_hostile(rng, good)]
    rng.shuffle(episodes)
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    try:
        projector = Projector(log)
        await projector.open()
        await log.append([*map(_declared, rng.sample(good, len(good)))])
        expected: list[Event] = []
        left = [*enumerate(episodes, 1)]
        while left:
            count = rng.randint(3, 12)
            some, left = left[:count], left[count:]
            await log.append([each for number, payload in some for each in _episode(number, payload)])
            await projector.catch_up()
            expected += [_event(number, payload) for number, payload in some if payload in good]
        stopped = await _compared(log, outcome, expected, good)
        await rebuild_memory(url)
        again = await _compared(log, outcome, expected, good)
        assert again == stopped, f"live {stopped} episodes are parked, rebuilt {again}"
        outcome.rounds -= 1  # it was one memory
        return stopped
    finally:
        await log.close()


async def _compared(log: EventLog, outcome: Outcome, expected: list[Event], good: list[bytes]) -> int:
    """What the views show of good types; and that the memory is whole. How many episodes are parked."""
    outcome.compare(expected, await asyncio.to_thread(_found, str(log.address.to_type), good))
    found = await verify(log)
    assert (found.damage, found.drift) == (0, 0), f"{found.damages[:1]} {found.differences[:1]}"
    assert all(each.reason for each in found.stopped)
    return len(found.stopped)


def _event(number: int, payload: bytes) -> Event:
    """What the tables must show of the only node of this episode."""
    script = Script(number)
    return episode_text(script.episode), 1, f"{len(_columns(payload))} values {number}"


def _found(url: str, good: list[bytes]) -> list[Event]:
    found: list[Event] = []
    for payload in good:
        declared = declaration_of(payload)
        columns = ", ".join(f'leaf."{each}"' for each in _columns(payload))
        rows = ask(
            url,
            f'SELECT uuid, {columns} FROM "{declared.table}" AS leaf JOIN designator ON designator.id = leaf.id'
            " JOIN process_metadata ON process_metadata.id = designator.process_metadata_id"
            f" WHERE dtype = '{declared.dtype}'",
        )
        for uuid, *values in rows:
            same = str(values[0]) if len({*values}) == 1 else str(values)
            found.append((uuid, 1, f"{len(values)} values {same}"))
    return found


def _columns(payload: bytes) -> list[str]:
    return [each.column for each in declaration_of(payload).fields if each.type == "integer"]


def _good(rng: random.Random) -> Iterator[bytes]:
    """As the hooks declare classes, also with names that a database has its own use for."""
    yield _payload(rng, "RootAction", ())
    for number in range(rng.randint(3, 6)):
        name = "".join(rng.choices(string.ascii_lowercase, k=rng.choice([3, 20, 44, 70, 200])))
        yield _payload(rng, f"{name.capitalize()}{number}Action", rng.choice([(), ("RootAction",)]))


def _payload(rng: random.Random, dtype: str, bases: tuple[str, ...]) -> bytes:
    names = {rng.choice(_NAMES) for _ in range(rng.randint(0, 3))} - {"true", "FALSE"} | {rng.choice(["true", "FALSE"])}
    names |= {rng.choice(["ä", "f"]) * rng.choice([1, 31, 59, 61, 63, 64, 120])}
    fields = [
        FieldDeclared(name, column_name(name, "integer"), "integer", slot) for slot, name in enumerate(sorted(names), 2)
    ]
    fields.append(FieldDeclared("container", "container_id", "object", len(fields) + 2))
    return encode(DesignatorTypeDeclared("action", dtype, table_name(dtype), bases=bases, fields=tuple(fields)))


def _hostile(rng: random.Random, good: list[bytes]) -> Iterator[bytes]:
    """Past every check of ours."""
    field = {"name": "size", "column": "size", "type": "real", "slot": 2}
    for number in range(rng.randint(3, 8)):
        known = msgspec.to_builtins(declaration_of(rng.choice(good)))
        one: dict[str, Any] = {"kind": "action", "dtype": f"Evil{number}Action", "table": f"evil{number}_action"}
        kinds: list[dict[str, Any]] = [
            one | {"fields": [field | dict.fromkeys(("name", "column"), rng.choice(_CRAFTED))]},
            one | {"fields": [field | {"name": f"f{n}", "column": f"f{n}", "slot": n} for n in range(3_000)]},
            one | {"fields": [field, field | {"name": "SIZE", "column": "SIZE", "slot": 3}]},
            one | {"fields": [field | {"slot": rng.choice([-1, 0, 1, 32, 2**40])}]},
            one | {"dtype": rng.choice(_DTYPES)},
            one | {"table": rng.choice(["pose", "Task_Tree_Node", "pose__7", "pycrorm_log", "a\0", "", "t" * 99])},
            one | {"bases": [f"Base{n}" for n in range(2_000)]},
            one | {"table": rng.choice([known["table"], known["table"].upper()])},
            known | {"kind": rng.choice(["motion", "language", "root"])},
            known | {"fields": [each | {"type": "text"} for each in known["fields"]]},
        ]
        yield rng.choice([*map(msgspec.json.encode, kinds), rng.choice(_NO_DECLARATIONS)])


def _declared(payload: bytes) -> Record:
    return Record(1, None, 0, "DesignatorTypeDeclared", 1, T0_NS, 0, payload)


def _episode(number: int, payload: bytes) -> list[Record]:
    """Its declaration, and an episode that performs this type once, with the number in every field."""
    script = Script(number)
    script.put(EpisodeStarted("foreign", "bench", "host", "1", "3.11"))
    try:
        given = {each.name: number for each in declaration_of(payload).fields if each.type == "integer"}
    except (ValueError, msgspec.DecodeError):
        given = {}
    node = script.put(NodeStarted("action", None, fingerprint(payload), given))
    script.put(NodeEnded(node, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return [_declared(payload), *script.records]
