"""The shipped mapped classes agree with the designators and expressions, and concepts of SOMA find them."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import isabstract
from typing import Any

import msgspec
import pytest
from sqlalchemy import Table, inspect, select

from pycrorm_async import orm, plan
from pycrorm_async.events.concepts import CONCEPT_OF_OBJECT_TYPE, CONCEPTS, ancestors
from pycrorm_async.events.fields import table_name
from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted, ObjectAdded
from pycrorm_async.orm import Action, Concept, ConceptAncestor, Designator, Language, Motion, Object, PickUpAction
from pycrorm_async.projections.columns import Layout
from pycrorm_async.projections.mapped_tables import mapped_leaves
from pycrorm_async.query.reading import Reading
from pycrorm_async.record.plan_types import declared_type
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.pose import ObjectType
from tests.projections.event_script import Script, declarations, declared, name_of, pose
from tests.projections.event_script import field as script_field
from tests.projections.sql_queries import stored_and_folded

# === built in classes =========================================================================================
#
# The shipped mapped classes agree with the shipped designators, field by field.

MODULES = (plan.actions, plan.motions)
PERFORMABLES = [
    each
    for module in MODULES
    for each in vars(module).values()
    if isinstance(each, type)
    and issubclass(each, plan.ActionAbstract | plan.BaseMotion)
    and each.__module__ == module.__name__
    if not isabstract(each)
]
EXPRESSIONS = [
    plan.Sequential,
    plan.TryInOrder,
    plan.Parallel,
    plan.TryAll,
    plan.Repeat,
    plan.Monitor,
    plan.Code,
    plan.Retry,
]
ROOTS = {"action": Action, "motion": Motion, "language": Language}


@pytest.mark.parametrize("designator", [*PERFORMABLES, *EXPRESSIONS], ids=lambda each: each.__name__)
def test_every_designator_has_a_mapped_class_into_whose_table_it_fits(designator: type) -> None:
    declaration = declared_type(designator).declaration
    mapped = getattr(orm, declaration.dtype)
    assert issubclass(mapped, ROOTS[declaration.kind])
    assert mapped.__tablename__ == declaration.table
    table = inspect(mapped).local_table
    assert isinstance(table, Table)
    columned = [each for each in declaration.fields if each.type not in ("list", "dict")]
    assert {each.name for each in table.columns} == {
        "id",
        "process_metadata_id",
        *(each.column for each in columned),
    }
    for field in declaration.fields:
        assert hasattr(mapped, field.name), field.name
    for kind in ("pose", "object"):
        first = next((each for each in columned if each.type == kind), None)
        if first is not None:
            assert getattr(mapped, f"{kind}_id").property.columns[0].name == first.column
            assert hasattr(mapped, kind)
    layout = Layout().with_leaves(mapped_leaves())
    assert layout.with_declaration(declaration) == layout


def test_every_name_of_the_thesis_exists() -> None:
    table_4_1 = (
        "CloseAction DetectAction GraspingAction GripAction LookAtAction MoveTorsoAction NavigateAction OpenAction"
        " ParkArmsAction PickUpAction PlaceAction ReleaseAction SetGripperAction TransportAction"
        " AccessingMotion ClosingMotion DetectingMotion LookingMotion MoveGripperMotion MoveMotion MoveTCPMotion"
        " OpeningMotion WorldStateDetectingMotion"
    )
    for name in table_4_1.split():
        assert issubclass(getattr(orm, name), Designator), name


def test_a_row_of_an_episode_begins_with_its_id_and_its_episode() -> None:
    for class_ in (orm.Pose, orm.Attachment):
        assert [each.name for each in class_.__table__.columns][:2] == ["id", "process_metadata_id"], class_


# === concepts =================================================================================================
#
# Queries by concept of SOMA find the subclasses of the concept, for tasks and for objects.


def of_concept(dtype: str, concept: str | None) -> DesignatorTypeDeclared:
    return msgspec.structs.replace(declared(dtype, table_name(dtype), script_field("what", "text", 2)), concept=concept)


TYPES = (
    of_concept("GraspingAction", "Grasping"),
    of_concept("LookAtAction", "LookingAt"),
    of_concept("GreetAction", "Greeting"),
    of_concept("WaitAction", None),
)


def recorded_types(base: Any) -> Iterator[Any]:
    for each in base.__subclasses__():
        yield each
        yield from recorded_types(each)


def test_every_concept_of_the_built_in_types_has_its_superclasses() -> None:
    types = (*recorded_types(plan.ActionAbstract), *recorded_types(plan.BaseMotion))
    used = {each.concept for each in types if each.__module__.startswith("pycrorm_async.")}
    assert used - {None} <= CONCEPTS.keys()
    assert {each.name for each in ObjectType} == CONCEPT_OF_OBJECT_TYPE.keys()
    assert {*CONCEPT_OF_OBJECT_TYPE.values()} <= CONCEPTS.keys()
    for each in used - {None}:
        assert [*ancestors(str(each))][-1] == "Task"
    for each in CONCEPT_OF_OBJECT_TYPE.values():
        assert "PhysicalObject" in ancestors(each)
    assert [*ancestors("LookingFor")] == [
        "LookingFor", "Perceiving", "InformationAcquisition", "PhysicalTask", "MentalTask", "Task",
    ]  # fmt: skip
    assert [*ancestors("Greeting")] == ["Greeting"]


def test_the_superclasses_are_those_of_soma_and_dul() -> None:
    assert CONCEPTS["Crockery"].parents == ("DesignedContainer", "Tableware")
    assert CONCEPTS["Tableware"].parents == ("DesignedTool",)
    assert CONCEPTS["PhysicalPlace"].parents == ("PhysicalObject",)
    assert CONCEPTS["PhysicalAgent"].parents == ("Agent", "PhysicalObject")
    assert CONCEPTS["NaturalPerson"].parents == ("Person", "PhysicalAgent")
    assert "Can" not in CONCEPTS
    assert "DesignedContainer" in ancestors("Cup")


@pytest.mark.slow
async def test_a_question_for_a_concept_finds_its_subclasses(log: EventLog) -> None:
    script = Script()
    for name, kind in (("milk", "MILK"), ("bowl", "BOWL"), ("spoon", "SPOON"), ("pr2", "ROBOT")):
        script.put(ObjectAdded(name, kind, pose()))
    for each in TYPES:
        script.put(NodeStarted("action", None, name_of(each), {"what": "it"}))
    await stored_and_folded(log, [*declarations(*TYPES), *script.records])
    reading = Reading(log)
    async with reading.session() as session:

        async def performed(concept: str) -> list[str]:
            query = select(Action.dtype).where(Action.is_a(concept)).order_by(Action.id)
            return list((await session.scalars(query)).all())

        assert await performed("PhysicalTask") == ["GraspingAction", "LookAtAction"]
        assert await performed("Manipulating") == await performed("Grasping") == ["GraspingAction"]
        assert await performed("Greeting") == ["GreetAction"]
        assert await performed("MentalTask") == []
        assert (await session.scalars(select(PickUpAction).where(PickUpAction.is_a("PhysicalTask")))).all() == []
        assert len((await session.scalars(select(Designator).where(Designator.is_a("Task")))).all()) == 2
        names = select(Object.name).where(Object.is_a("Tableware")).order_by(Object.id)
        assert (await session.scalars(names)).all() == ["bowl", "spoon"]
        above = select(ConceptAncestor.ancestor).where(ConceptAncestor.concept == "MilkPack")
        assert set(await session.scalars(above)) == {*ancestors("MilkPack")}
        looking = (await session.scalars(select(Concept).where(Concept.name.in_(["Perceiving", "Task"])))).all()
        assert sorted((each.name, each.parent or "", each.source) for each in looking) == [
            ("Perceiving", "InformationAcquisition", "SOMA 2.1.0"),
            ("Perceiving", "PhysicalTask", "SOMA 2.1.0"),
            ("Task", "", "DUL 3.32"),
        ]
    by_hand = (
        "SELECT action.dtype FROM action JOIN designator_type USING (dtype) JOIN concept_ancestor USING (concept)"
        " WHERE ancestor = 'Manipulating'"
    )
    async with log.engine.connect() as connection:
        assert (await connection.exec_driver_sql(by_hand)).scalars().all() == ["GraspingAction"]
