"""The view of what an object was on, in or next to when it was picked up, and after it was placed."""

from __future__ import annotations

import math
from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.types import (
    BlobReference,
    JointsMoved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
)
from pycrorm_async.orm import SpatialRelation
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.record.geometry import Descriptions
from pycrorm_async.record.values import MissingValues
from pycrorm_async.settings import Settings
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import BulletWorld, Object, ObjectType
from pycrorm_async.world.model_boxes import link_boxes
from pycrorm_async.world.models import built_in_model
from tests.projections.event_script import PICK_UP, T0_NS, Script, declarations, declared, field, name_of, pose, row
from tests.projections.sql_queries import ask, stored_and_folded
from tests.projections.verify_cases import rebuilt

pytestmark = pytest.mark.slow

PLACE = declared(
    "PlaceAction",
    "place_action",
    field("object_designator", "object", 2),
    field("arm", "enum", 3),
    field("target_location", "pose", 4),
)
DRAWER = "kitchen_counter_upper_drawer"


class Tidying:
    """A script of an episode in the built-in kitchen."""

    def __init__(self) -> None:
        self.script = Script()
        self.rows: dict[str, tuple[int, int]] = {}
        self.add("kitchen", "ENVIRONMENT", 0, 0, 0)

    def add(self, name: str, kind: str, *at: float, turned: float = 0.0, description: str | None = None) -> None:
        sequence = self.script.put(ObjectAdded(name, kind, pose(*at, turned=turned), description=description))
        self.rows[name] = sequence, sequence

    def move(self, name: str, kind: str, *at: float) -> None:
        identity = self.rows[name][0]
        self.rows[name] = identity, self.script.put(ObjectMoved(identity, name, kind, pose(*at)))

    def reference(self, name: str) -> ObjectReference:
        return ObjectReference(*self.rows[name])

    def pick_up(self, name: str, *, simulated: bool = False) -> int:
        parameters: dict[str, Any] = {"object_designator": self.reference(name), "arm": "LEFT", "grasp": "TOP"}
        node = self.script.put(NodeStarted("action", None, name_of(PICK_UP), parameters, simulated=simulated))
        self.script.put(NodeEnded(node, "SUCCEEDED"))
        return row(node)

    def start_placing(self, name: str) -> int:
        parameters = {"object_designator": self.reference(name), "arm": "LEFT", "target_location": pose()}
        return self.script.put(NodeStarted("action", None, name_of(PLACE), parameters))


class Declared:
    """Takes the descriptions that a recorder declares."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def put_payload(self, heading: Heading, payload: bytes) -> int:
        position = 1_000 + len(self.records)
        self.records.append(Record(position, None, 0, heading.type, heading.version, T0_NS, 0, payload))
        return position

    def put_blob(self, content: bytes, media_type: str) -> BlobReference:
        raise AssertionError

    def description(self, urdf: str) -> str:
        """Return the fingerprint of an object's description, made from this URDF as a plan makes it."""
        with BulletWorld():
            made = Object("made", ObjectType.GENERIC_OBJECT, urdf)
            fingerprint = Descriptions(self, Settings(), MissingValues()).declare(made)
        assert fingerprint is not None
        return fingerprint


async def relations(
    log: EventLog, tidying: Tidying, declared_: Declared | None = None
) -> dict[int, set[tuple[str, str, str]]]:
    """Store the script; return relation, other object and link by node."""
    described = declared_.records if declared_ is not None else []
    await stored_and_folded(log, [*declarations(PICK_UP, PLACE), *described, *tidying.script.records])
    found: dict[int, set[tuple[str, str, str]]] = {}
    async with AsyncSession(log.engine) as session:
        for each in await session.scalars(select(SpatialRelation)):
            found.setdefault(each.node_id, set()).add((each.relation, each.other, each.link))
    return found


async def test_a_picked_up_object_is_related_as_it_was_before(log: EventLog) -> None:
    tidying = Tidying()
    tidying.add("milk", "MILK", 1.3, 1.0, 0.9)
    tidying.add("cup", "JEROEN_CUP", 1.3, 1.12, 0.862)
    tidying.add("spoon", "SPOON", 1.3, 0.9, 0.83)
    tidying.script.put(ObjectRemoved(tidying.reference("spoon")))
    tidying.add("cereal", "BREAKFAST_CEREAL", 1.3, 0.8, 0.95, turned=math.sqrt(0.5))
    tidying.add("bowl", "BOWL", 1.3, 0.2, 0.88)
    picked = tidying.pick_up("milk")
    tidying.move("cup", "JEROEN_CUP", 0, 0, 0)
    assert await relations(log, tidying) == {
        picked: {
            ("on", "kitchen", "sink_area_surface"),
            ("next to", "cup", "cup"),
            ("next to", "cereal", "cereal"),  # turned by a quarter, its wide side is along y
        }
    }


async def test_a_placed_object_is_related_as_it_is_at_the_end(log: EventLog) -> None:
    tidying = Tidying()
    tidying.add("milk", "MILK", 1.3, 1.0, 0.9)
    tidying.add("bowl", "BOWL", 1.3, 0.2, 0.88)
    placed = tidying.start_placing("milk")
    tidying.move("milk", "MILK", 1.3, 0.39, 0.936 + 0.01)
    tidying.script.put(NodeEnded(placed, "SUCCEEDED"))
    tidying.move("milk", "MILK", 5, 5, 5)
    tidying.start_placing("milk")
    assert await relations(log, tidying) == {
        row(placed): {("on", "kitchen", "kitchen_counter_surface"), ("next to", "bowl", "bowl")}
    }


async def test_an_object_is_in_a_drawer_where_its_joint_has_it(log: EventLog) -> None:
    tidying = Tidying()
    tidying.add("cup", "JEROEN_CUP", 0.85, 0.35, 0.67)
    outside = tidying.pick_up("cup")
    tidying.script.put(JointsMoved(tidying.reference("kitchen"), {f"{DRAWER}_joint": 0.35}))
    inside = tidying.pick_up("cup")
    tidying.pick_up("cup", simulated=True)
    tidying.script.put(JointsMoved(tidying.reference("kitchen"), {f"{DRAWER}_joint": 0.0}))
    closed = tidying.pick_up("cup")
    found = await relations(log, tidying)
    assert found == {inside: {("in", "kitchen", DRAWER)}}
    assert not {outside, closed} & found.keys()


async def test_a_relation_leads_to_its_node_and_names_both_rows(log: EventLog) -> None:
    tidying = Tidying()
    tidying.add("bowl", "BOWL", 1.3, 0.2, 0.88)
    tidying.add("spoon", "SPOON", 1.3, 0.2, 0.9255)
    picked = tidying.pick_up("spoon")
    await relations(log, tidying)
    reading = Reading(log)
    async with reading.session() as session:
        query = select(SpatialRelation).where(SpatialRelation.other == "bowl", SpatialRelation.process_metadata_id == 1)
        (on_bowl,) = await session.scalars(query)
        assert (on_bowl.object, on_bowl.relation) == ("spoon", "on")
        assert (on_bowl.object_id, on_bowl.other_id) == (row(tidying.rows["spoon"][1]), row(tidying.rows["bowl"][1]))
        with pytest.raises(CallerError, match="node of SpatialRelation"):
            _ = on_bowl.node
        assert (await on_bowl.awaitable_attrs.node).id == picked
    frame = await reading.dataframe(select(SpatialRelation.object, SpatialRelation.relation, SpatialRelation.other))
    assert sorted(frame.itertuples(index=False)) == [
        ("spoon", "on", "bowl"),
    ]


def box_urdf(name: str, size: str, at: str = "0 0 0", rpy: str = "0 0 0") -> str:
    shape = f'<origin xyz="{at}" rpy="{rpy}"/><geometry><box size="{size}"/></geometry>'
    return f'<robot name="{name}">\n<link name="{name}"><collision>{shape}</collision></link></robot>'


async def test_an_object_has_the_size_of_its_description_and_not_of_its_type(log: EventLog) -> None:
    declared_, tidying = Declared(), Tidying()
    crate = declared_.description(box_urdf("crate", "0.6 0.4 0.3"))
    big_milk = declared_.description(box_urdf("big", "0.1 0.1 0.4", at="0 0 0.2"))
    lying = declared_.description(box_urdf("lying", "0.02 0.3 0.02", rpy="0 0 1.5707963267948966"))
    tidying.add("crate", "MILK", 5, 5, 0.15, description=crate)
    tidying.add("milk", "MILK", 5.2, 5.1, 0.3, description=big_milk)
    tidying.add("bar", "SPOON", 5.49, 5.1, 0.5, description=lying)  # from 5.34 on, 0.09 beside the milk
    tidying.add("old milk", "MILK", 5, 5.15, 0.35)  # beside the milk, but not as far as one of its type reaches
    picked = tidying.pick_up("milk")
    assert await relations(log, tidying, declared_) == {picked: {("on", "crate", "crate"), ("next to", "bar", "bar")}}


async def test_relations_end_at_their_distances_and_an_environment_is_no_neighbour(log: EventLog) -> None:
    declared_, tidying = Declared(), Tidying()
    crate = declared_.description(box_urdf("crate", "0.4 0.4 0.3"))
    block = declared_.description(box_urdf("block", "0.1 0.1 0.1"))
    picked = {}
    for number, (kind, ahead, height) in enumerate(
        [
            ("GENERIC_OBJECT", 0.0, 0.35 + 0.019),
            ("GENERIC_OBJECT", 0.0, 0.35 + 0.021),
            ("GENERIC_OBJECT", 0.25 + 0.099, 0.1),
            ("GENERIC_OBJECT", 0.25 + 0.101, 0.1),
            ("ENVIRONMENT", 0.25 + 0.05, 0.1),
        ]
    ):
        tidying.add(f"crate {number}", kind, 50 + 10 * number, 50, 0.15, description=crate)
        tidying.add(f"block {number}", "GENERIC_OBJECT", 50 + 10 * number + ahead, 50, height, description=block)
        picked[number] = tidying.pick_up(f"block {number}")
    assert await relations(log, tidying, declared_) == {
        picked[0]: {("on", "crate 0", "crate 0")},
        picked[2]: {("next to", "crate 2", "crate 2")},
    }


async def test_an_object_is_in_a_sliding_part_of_a_recorded_description(log: EventLog) -> None:
    declared_, tidying = Declared(), Tidying()
    box = '<collision><geometry><box size="{}"/></geometry></collision>'
    chest = declared_.description(
        f"""<robot name="chest">
<link name="frame"/>
<link name="tray">{box.format("0.4 0.4 0.2")}</link>
<link name="lid">{box.format("0.4 0.4 0.02")}</link>
<joint name="slide" type="prismatic"><parent link="frame"/><child link="tray"/>
<origin xyz="0 0 0.5" rpy="0 0 1.5707963267948966"/><axis xyz="2 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<joint name="hinge" type="revolute"><parent link="frame"/><child link="lid"/><axis xyz="1 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
    )
    tidying.add("chest", "GENERIC_OBJECT", 5, 5, 0, turned=1.0, description=chest)  # turned half around z
    tidying.add("cup", "JEROEN_CUP", 5, 4.4, 0.5)
    tidying.pick_up("cup")
    tidying.script.put(JointsMoved(tidying.reference("chest"), {"slide": 0.6}))
    inside = tidying.pick_up("cup")
    assert await relations(log, tidying, declared_) == {inside: {("in", "chest", "tray")}}


async def boxes_by_model(log: EventLog, generation: int = 1001) -> dict[str, int]:
    return dict(await ask(log, f"SELECT model, count(*) FROM zz_pycrorm_link_box__{generation} GROUP BY model"))


@pytest.mark.soak_on("sqlite")
async def test_the_boxes_of_a_description_are_stored_once_rebuilt_and_verified(log: EventLog) -> None:
    declared_, tidying = Declared(), Tidying()
    kitchen = declared_.description(built_in_model("kitchen"))
    crate = declared_.description(box_urdf("crate", "0.6 0.4 0.3"))
    tidying.add("home", "ENVIRONMENT", 9, 0, 0, description=kitchen)
    records = [*declarations(PICK_UP, PLACE), *declared_.records, *tidying.script.records]
    projector = await stored_and_folded(log, records)
    links = sum(not each.link.endswith("_handle") for each in link_boxes(built_in_model("kitchen")))
    assert await boxes_by_model(log) == {kitchen: links}  # no object is made from the other one yet
    again = Script(2)
    for description in (crate, kitchen, crate):
        again.put(ObjectAdded("it", "GENERIC_OBJECT", pose(), description=description))
    await log.append(again.records)
    await projector.catch_up()
    assert await boxes_by_model(log) == {kitchen: links, crate: 1}
    rows = sorted(await ask(log, "SELECT * FROM zz_pycrorm_link_box__1001"), key=repr)
    async with log.writing() as connection:
        await connection.exec_driver_sql(f"UPDATE zz_pycrorm_link_box__1001 SET hx = 7.0 WHERE model = '{crate}'")
    [difference] = (await verify(log)).differences
    assert str(difference) == "pycrorm_link_box.hx is 7.0, and should be 0.3"
    await rebuilt(log)
    assert sorted(await ask(log, "SELECT * FROM zz_pycrorm_link_box__1002"), key=repr) == rows
    assert (await verify(log)).drift == 0
