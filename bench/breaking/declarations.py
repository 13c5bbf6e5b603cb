"""Append declarations of other programs to the log: valid types among hostile ones."""

from __future__ import annotations

import asyncio
import random
import string
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.events.codec import Record, declaration_of, encode, fingerprint
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
from pycrorm_async.projections.verify import verify
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
    """Fill one memory a round; the events of valid types must be in its tables, after live folding and a rebuild."""

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome()
        parked = 0
        for number in range(rounds):
            place = folder / str(number)
            place.mkdir()
            parked += asyncio.run(_round(new(place), rng, outcome))
            step()
        outcome.note = f"{parked} episodes of hostile types parked with a reason"
        return outcome

    return run


async def _round(url: str, rng: random.Random, outcome: Outcome) -> int:
    """Append episodes of valid and hostile types in random order; return the number of parked episodes."""
    valid = [*_valid(rng)]
    episodes = [*valid, *_hostile(rng, valid)]
    rng.shuffle(episodes)
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    try:
        projector = Projector(log)
        await projector.open()
        await log.append([*map(_declared, rng.sample(valid, len(valid)))])
        expected: list[Event] = []
        remaining = [*enumerate(episodes, 1)]
        while remaining:
            count = rng.randint(3, 12)
            chunk, remaining = remaining[:count], remaining[count:]
            await log.append([each for number, payload in chunk for each in _episode(number, payload)])
            await projector.catch_up()
            expected += [_event(number, payload) for number, payload in chunk if payload in valid]
        parked = await _compare_and_verify(log, outcome, expected, valid)
        await rebuild_memory(url)
        rebuilt = await _compare_and_verify(log, outcome, expected, valid)
        assert rebuilt == parked, f"{parked} episodes are parked after live folding, {rebuilt} after the rebuild"
        outcome.rounds -= 1  # both comparisons belong to one round
        return parked
    finally:
        await log.close()


async def _compare_and_verify(log: EventLog, outcome: Outcome, expected: list[Event], valid: list[bytes]) -> int:
    """Compare the rows of valid types, and verify the memory; return the number of parked episodes."""
    outcome.compare(expected, await asyncio.to_thread(_rows, str(log.address.to_type), valid))
    result = await verify(log)
    assert (result.damage, result.drift) == (0, 0), f"{result.damages[:1]} {result.differences[:1]}"
    assert all(each.reason for each in result.stopped)
    return len(result.stopped)


def _event(number: int, payload: bytes) -> Event:
    """Return the row that the tables must contain for the only node of this episode."""
    script = Script(number)
    return episode_text(script.episode), 1, f"{len(_columns(payload))} values {number}"


def _rows(url: str, valid: list[bytes]) -> list[Event]:
    events: list[Event] = []
    for payload in valid:
        declaration = declaration_of(payload)
        columns = ", ".join(f'leaf."{each}"' for each in _columns(payload))
        rows = ask(
            url,
            f'SELECT uuid, {columns} FROM "{declaration.table}" AS leaf JOIN designator ON designator.id = leaf.id'
            " JOIN process_metadata ON process_metadata.id = designator.process_metadata_id"
            f" WHERE dtype = '{declaration.dtype}'",
        )
        for uuid, *values in rows:
            text = str(values[0]) if len({*values}) == 1 else str(values)
            events.append((uuid, 1, f"{len(values)} values {text}"))
    return events


def _columns(payload: bytes) -> list[str]:
    return [each.column for each in declaration_of(payload).fields if each.type == "integer"]


def _valid(rng: random.Random) -> Iterator[bytes]:
    """Yield declarations as the hooks make them, also with names that are keywords of a database."""
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


def _hostile(rng: random.Random, valid: list[bytes]) -> Iterator[bytes]:
    """Yield declarations that the hooks would refuse."""
    field = {"name": "size", "column": "size", "type": "real", "slot": 2}
    for number in range(rng.randint(3, 8)):
        existing = msgspec.to_builtins(declaration_of(rng.choice(valid)))
        evil: dict[str, Any] = {"kind": "action", "dtype": f"Evil{number}Action", "table": f"evil{number}_action"}
        variants: list[dict[str, Any]] = [
            evil | {"fields": [field | dict.fromkeys(("name", "column"), rng.choice(_CRAFTED))]},
            evil | {"fields": [field | {"name": f"f{n}", "column": f"f{n}", "slot": n} for n in range(3_000)]},
            evil | {"fields": [field, field | {"name": "SIZE", "column": "SIZE", "slot": 3}]},
            evil | {"fields": [field | {"slot": rng.choice([-1, 0, 1, 32, 2**40])}]},
            evil | {"dtype": rng.choice(_DTYPES)},
            evil | {"table": rng.choice(["pose", "Task_Tree_Node", "pose__7", "pycrorm_log", "a\0", "", "t" * 99])},
            evil | {"bases": [f"Base{n}" for n in range(2_000)]},
            evil | {"table": rng.choice([existing["table"], existing["table"].upper()])},
            existing | {"kind": rng.choice(["motion", "language", "root"])},
            existing | {"fields": [each | {"type": "text"} for each in existing["fields"]]},
        ]
        yield rng.choice([*map(msgspec.json.encode, variants), rng.choice(_NO_DECLARATIONS)])


def _declared(payload: bytes) -> Record:
    return Record(1, None, 0, "DesignatorTypeDeclared", 1, T0_NS, 0, payload)


def _episode(number: int, payload: bytes) -> list[Record]:
    """Return the declaration, and an episode that performs this type once, with the number in every field."""
    script = Script(number)
    script.put(EpisodeStarted("foreign", "bench", "host", "1", "3.11"))
    try:
        parameters = {each.name: number for each in declaration_of(payload).fields if each.type == "integer"}
    except (ValueError, msgspec.DecodeError):
        parameters = {}
    node = script.put(NodeStarted("action", None, fingerprint(payload), parameters))
    script.put(NodeEnded(node, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return [_declared(payload), *script.records]
