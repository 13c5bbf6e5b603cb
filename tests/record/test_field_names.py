"""A field of a designator may have any name, also one that the memory itself uses; no name is taken for another one."""

from __future__ import annotations

import dataclasses
import keyword
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq
import pytest
from sqlalchemy import column, select, table
from sqlalchemy.orm import undefer

from pycrorm_async import Memory, performable_of
from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import Record
from pycrorm_async.events.fields import RESERVED_COLUMNS
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared, NodeStarted
from pycrorm_async.orm import Action, TaskTreeNode
from pycrorm_async.orm.base import Base
from pycrorm_async.plan import ActionAbstract, BaseMotion
from pycrorm_async.projections.columns import CORE, OF_NO_EPISODE
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.success import success_samples
from pycrorm_async.recall.columns import RESERVED
from pycrorm_async.record.plan_types import declared_type
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.contracts import check_designator
from tests.databases import ask, put_memory

_METHODS = {"perform", "resources", "resolve"}
_OF_SQL = "rowid oid ctid xmin tableoid true false order group select user limit picked placed added earlier later"
_VALUES: dict[type, tuple[Any, ...]] = {
    int: (2**53 + 1, 0, None),
    str: ("yes", "", None),
    float: (0.1, 0.0, None),
}


def names_of_ours() -> list[str]:
    """Return the names of all columns, of the attributes of mapped classes and events, and of aliases in views."""
    tables = [*CORE.values(), *OF_NO_EPISODE.values(), *(each.columns.keys() for each in Base.metadata.tables.values())]
    events = [each for kind in (NodeStarted, DesignatorTypeDeclared, FieldDeclared) for each in kind.__struct_fields__]
    names = {*RESERVED_COLUMNS, *RESERVED, *_OF_SQL.split(), *dir(Action), *dir(ActionAbstract), *vars(TaskTreeNode)}
    names |= {*events, *(name for each in tables for name in each)}
    names |= {"aliases", "object", "pose", "object_id", "pose_id", "Kind", "ID", "kind_"}
    return sorted(each for each in names - _METHODS if each[0] != "_" and not keyword.iskeyword(each))


NAMES = names_of_ours()


async def _nothing(_self: object) -> None:
    """Succeed without doing anything."""


def designators(kind: type) -> list[type[ActionAbstract]]:
    """Return classes that have fields of all these names and this type, as many each as a type may have."""
    return [
        make_dataclass(
            f"{kind.__name__.title()}{first}Action",
            [(name, kind | None, None) for name in NAMES[first : first + 30]],
            bases=(ActionAbstract,),
            namespace={"perform": _nothing, "__module__": __name__},
        )
        for first in range(0, len(NAMES), 30)
    ]


class Recorded(NamedTuple):
    """A recorded type: its declared fields by the names that the designator gives them, and the values of its nodes."""

    dtype: str
    table: str
    fields: Mapping[str, FieldDeclared]
    rows: list[dict[str, Any]]
    designator: type[ActionAbstract] | None


async def performed(kind: type) -> list[Recorded]:
    """Perform an action of each class with each value, and return what must be recorded."""
    done = []
    for designator in designators(kind):
        declared = declared_type(designator)
        names = [each.name for each in dataclasses.fields(designator)]  # type: ignore[arg-type]  # made above
        assert [each.path for each in declared.fields] == [(each,) for each in names]
        rows = [dict.fromkeys(names, value) for value in _VALUES[kind]]
        for values in rows:
            await designator(**values).perform()
        fields = dict(zip(names, declared.declaration.fields, strict=True))
        done.append(Recorded(declared.dtype, declared.declaration.table, fields, rows, designator))
    return done


def received(recording: Recording, episode: RecordedEpisode, kind: type) -> list[Recorded]:
    """Record nodes with the same fields as another executive does."""
    done = []
    for first in range(0, len(NAMES), 30):
        names = NAMES[first : first + 30]
        declared = recording.type("action", f"{kind.__name__.title()}{first}Other", dict.fromkeys(names, kind))
        assert [each.path for each in declared.fields] == [(each,) for each in names]
        rows = [dict.fromkeys(names, value) for value in _VALUES[kind]]
        for values in rows:
            episode.start("node", declared, values)
            episode.end("node", "SUCCEEDED")
        fields = dict(zip(names, declared.declaration.fields, strict=True))
        done.append(Recorded(declared.dtype, declared.declaration.table, fields, rows, None))
    return done


async def assert_shown(memory: Memory, types: Sequence[Recorded], folder: Path) -> None:
    """Compare the nodes' parameters, the view, the mapped class, the frame and an exported file with the values."""
    for each in types:
        mapped = memory.mapped(each.dtype)
        columns = [each.fields[name].column for name in each.fields]
        expected = [{each.fields[name].name: value for name, value in row.items()} for row in each.rows]
        async with memory.session() as session:
            view: Any = select(*map(column, columns)).select_from(table(each.table)).order_by(column("id"))
            in_view = [list(row) for row in await session.execute(view)]
            rows = (
                await session.scalars(select(mapped).order_by(mapped.id).options(undefer(mapped._parameters)))
            ).all()
            parameters = [row.parameters for row in rows]
            in_class = [{name: getattr(row, name) for name in expected[0]} for row in rows]
            again = [performable_of(row) for row in rows] if each.designator is not None else []
        assert parameters == [{name: value for name, value in row.items() if value is not None} for row in expected]
        assert in_view == [list(row.values()) for row in expected], each.dtype
        assert in_class == expected, each.dtype
        assert [vars(one) for one in again] == (each.rows if again else []), each.dtype
        frame = await memory.dataframe(select(mapped).order_by(mapped.id), to="arrow")
        assert frame.select(list(expected[0])).to_pylist() == expected, each.dtype
        if each.designator is not None:
            file = folder / f"{each.dtype}.parquet"
            await memory.export(select(mapped).order_by(mapped.id), file, force=True)
            assert pq.read_table(file).select(list(expected[0])).to_pylist() == expected, each.dtype


async def assert_clean(url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        result = await verify(log)
    finally:
        await log.close()
    assert [*result.damages, *result.differences, *result.stopped, *result.unmade.items()] == []
    assert not result.behind
    assert result.outdated is None


@pytest.mark.soak_on(int, float, "postgresql")
@pytest.mark.parametrize("kind", _VALUES, ids=lambda kind: kind.__name__)
async def test_a_field_with_a_name_of_ours_has_its_value_in_node_view_class_frame_and_file(
    database_url: str, kind: type, tmp_path: Path
) -> None:
    async with Memory.open(database_url) as memory:
        async with memory.episode(description="names of ours"):
            types = await performed(kind)
        assert not memory.status.missing.total
        with memory.recording.episode() as episode:
            types += received(memory.recording, episode, kind)
        await memory.flush()
        assert not memory.status.faults.total
        await assert_shown(memory, types, tmp_path)
    await assert_clean(database_url)


def test_a_reserved_name_gets_underscores_until_no_other_field_has_it() -> None:
    made = make_dataclass(
        "ManyAction",
        [
            ("kind_", int),
            ("kind", str),
            ("Kind", str),
            ("object", str),
            ("node", list[int]),
            ("id__", int),
            ("id", int),
        ],
        bases=(ActionAbstract,),
        namespace={"perform": _nothing, "__module__": __name__},
    )
    fields = declared_type(made).declaration.fields
    assert [each.name for each in fields] == ["kind_", "kind__", "Kind___", "object_", "node_", "id__", "id_"]
    assert [each.column for each in fields] == [each.name for each in fields]


# --- the class describes itself ---------------------------------------------------------------------------------


@dataclass
class PourActionPerformable(ActionAbstract):
    kind: str = "motion"
    dtype: str = "tea"
    concept: int = 3
    aliases: int = 4
    orm_class: int = 5

    async def perform(self) -> None:
        """Succeed without doing anything."""


@dataclass
class StirMotion(BaseMotion):
    kind: str
    dtype: str
    concept: float

    async def perform(self) -> None:
        """Succeed without doing anything."""


@dataclass(slots=True)
class CarefulPourActionPerformable(PourActionPerformable):
    concept: int = 9


class WipeActionPerformable(ActionAbstract):
    dtype = "WipingAction"
    concept = "Wiping"

    def __init__(self, kind: str, aliases: str) -> None:
        self.kind = kind
        self.aliases = aliases

    async def perform(self) -> None:
        """Succeed without doing anything."""


DESCRIBED: list[Any] = [PourActionPerformable, StirMotion, CarefulPourActionPerformable, WipeActionPerformable]


def test_what_describes_a_class_is_read_from_the_class_and_never_from_a_field() -> None:
    described = [
        (each.kind, each.dtype, each.concept, each.aliases, each.bases)
        for each in (declared_type(kind).declaration for kind in DESCRIBED)
    ]
    assert described == [
        ("action", "PourAction", None, (), ()),
        ("motion", "StirMotion", None, (), ()),
        ("action", "CarefulPourAction", None, (), ("PourAction",)),
        ("action", "WipingAction", "Wiping", (), ()),
    ]
    with pytest.raises(TypeError, match="missing 3 required positional arguments: 'kind', 'dtype', and 'concept'"):
        StirMotion()  # type: ignore[call-arg]  # the fault here


class Described:
    concept = "Mixing"

    @property
    def kind(self) -> str:
        """The user's own property."""
        return "a property"


def test_attributes_of_a_users_own_base_class_stay_as_they_are() -> None:
    own = {"perform": _nothing}
    made: Any = make_dataclass("MixActionPerformable", [], bases=(Described, ActionAbstract), namespace=own)
    below: Any = make_dataclass("MixAgainActionPerformable", [], bases=(made,))
    for each in made, below:
        assert (each().kind, each.concept) == ("a property", "Mixing")
        assert (each.__kind__, each.__concept__) == ("action", None)


@pytest.mark.parametrize("name", ["perform", "resolve", "resources", "_name_in_memory"])
def test_a_field_with_the_name_of_a_method_is_refused_in_one_line_when_its_class_is_defined(name: str) -> None:
    with pytest.raises(CallerError, match=rf"MadeAction\.{name} must .*: rename the field") as refused:
        make_dataclass("MadeAction", [(name, str)], bases=(ActionAbstract,))
    assert "\n" not in str(refused.value)
    mixin = make_dataclass("Mixin", [(name, str)])
    with pytest.raises(CallerError):
        type("MadeAction", (mixin, ActionAbstract), {})


async def test_a_plot_of_a_type_with_a_field_status_counts_the_status_of_its_nodes(tmp_path: Path) -> None:
    made = make_dataclass(
        "LightAction",
        [("status", str), ("x", float), ("y", float)],
        bases=(ActionAbstract,),
        namespace={"perform": _nothing, "__module__": __name__},
    )
    async with Memory.open(put_memory(tmp_path / "memory.db")) as memory:
        await made("RUNNING", 1.0, 2.0).perform()
        await memory.flush()
        samples = await success_samples(memory.reading, "x", "y", "LightAction")
    assert list(samples.succeeded) == [True]


async def test_check_designator_compares_a_field_with_a_reserved_name(tmp_path: Path) -> None:
    row = await check_designator(PourActionPerformable(), tmp_path)
    assert (row.kind, row.kind_, row.dtype, row.dtype_) == ("action", "motion", "PourAction", "tea")


# --- events of earlier versions -----------------------------------------------------------------------------------

_POUR = (
    b'{"kind":"action","dtype":"PourAction","table":"pour_action","fields":[{"name":"ml","column":"ml",'
    b'"type":"integer","slot":2}]}'
)
_MIX = (
    b'{"kind":"action","dtype":"MixAction","table":"mix_action","concept":3,"fields":[{"name":"concept",'
    b'"column":"concept","type":"integer","slot":2}]}'
)
_POURED = (
    b'{"kind":%s,"parent":2,"designator":"8b210ce81974abdac9976f30df6ff8a2","parameters":{"ml":3,"kind":{"missing":'
    b'"field \'kind\' has a reserved name (kind)","repr":"\'water\'"}}}'
)
_EARLIER = [
    b'{"kind":"root"}',
    *(_POURED % kind for kind in (b'"water"', b'"motion"', b"7", b'"root"', b"null", b'["a"]')),
    b'{"kind":"slow","parent":2,"parameters":{"speed":2}}',
    b'{"kind":"action","parent":2,"designator":"9591f00485c796a3715132553528e2b9","parameters":{"concept":3}}',
]
"""Payloads that the recorder of an earlier version wrote for designators with fields `kind` and `concept`."""


@pytest.mark.soak_on("postgresql")
async def test_events_with_a_field_of_the_user_in_place_of_kind_or_concept_are_folded(database_url: str) -> None:
    episode = EpisodeId(bytes([*bytes(6), 0x70, 0, 0x80, *bytes(6), 1]))
    types = [Record(at, None, 0, "DesignatorTypeDeclared", 1, 1, 1, each) for at, each in enumerate((_POUR, _MIX), 1)]
    start = b'{"description":"x","created_by":"me","host":"vm","software":"0.2.0","python":"3.11.7"}'
    events = [("EpisodeStarted", start), *(("NodeStarted", each) for each in _EARLIER)]
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    try:
        await log.append([*types, *(Record(2 + at, episode, at, *each) for at, each in enumerate(_stamped(events), 1))])
        projector = Projector(log)
        await projector.open()
        await projector.catch_up()
    finally:
        await log.close()
    nodes = ask(database_url, "SELECT kind, dtype FROM task_tree_node ORDER BY id")
    assert nodes == [("root", None), *[("action", "PourAction")] * 6, ("action", None), ("action", "MixAction")]
    assert ask(database_url, "SELECT ml FROM pour_action") == [(3,)] * 6
    await assert_clean(database_url)


def _stamped(events: list[tuple[str, bytes]]) -> Iterator[tuple[str, int, int, int, bytes]]:
    return ((name, 1, at, at, payload) for at, (name, payload) in enumerate(events, 1))


def test_half_of_a_surrogate_pair_in_a_name_or_concept_keeps_neither_the_type_nor_its_values_from_being_recorded(
    tmp_path: Path,
) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    bad = "a\udc80b"
    with Memory.sync(url) as memory:
        declared = memory.recording.type("action", "HalfAction", {bad: str, "x": str}, concept=f"soma:{bad}")
        with memory.recording.episode() as episode:
            episode.start("node", declared, {bad: "v", "x": "w"})
            episode.end("node")
        memory.flush()
        assert not memory.status.faults.total
    assert ask(url, "SELECT a_b, x FROM half_action") == [("v", "w")]
