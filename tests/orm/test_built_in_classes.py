"""The shipped mapped classes agree with the shipped designators, field by field."""

from __future__ import annotations

import subprocess
import sys

import pytest
from sqlalchemy import Table, inspect

import pycrorm_async.orm
from pycrorm_async.orm import Action, Designator, Motion
from pycrorm_async.plan import actions, motions
from pycrorm_async.projections.columns import Layout
from pycrorm_async.projections.mapped_tables import built_in_leaves, leaves_of, mapped_leaves
from pycrorm_async.record.declarations import declared_type
from tests.commands import environment

MODULES = (actions, motions)
PERFORMABLES = [getattr(module, name) for module in MODULES for name in module.__all__]


@pytest.mark.parametrize("designator", PERFORMABLES, ids=lambda each: each.dtype)
def test_every_action_and_motion_has_a_mapped_class(designator: type) -> None:
    declaration = declared_type(designator).declaration
    mapped = getattr(pycrorm_async.orm, declaration.dtype)
    assert issubclass(mapped, Action if declaration.kind == "action" else Motion)
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


@pytest.mark.parametrize("designator", PERFORMABLES, ids=lambda each: each.dtype)
def test_every_declaration_of_a_plan_fits_into_the_tables_of_the_classes(designator: type) -> None:
    layout = Layout().with_leaves(mapped_leaves())
    declaration = declared_type(designator).declaration
    assert layout.with_declaration(declaration) == layout


def test_the_listed_tables_are_those_of_the_classes() -> None:
    assert built_in_leaves() == [each for each in leaves_of(Designator) if each.dtype is not None]


_LIGHT = """
import sys
import pycrorm_async.cli.copy, pycrorm_async.cli.rebuild, pycrorm_async.cli.verify, pycrorm_async.cli.writer
import pycrorm_async.cli.status
raise SystemExit("the mapped classes are imported" if "pycrorm_async.orm" in sys.modules else 0)
"""


@pytest.mark.slow
def test_commands_that_query_no_mapped_class_import_none() -> None:
    command = [sys.executable, "-c", _LIGHT]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_name_of_the_thesis_exists() -> None:
    table_4_1 = (
        "CloseAction DetectAction GraspingAction GripAction LookAtAction MoveTorsoAction NavigateAction OpenAction"
        " ParkArmsAction PickUpAction PlaceAction ReleaseAction SetGripperAction TransportAction"
        " AccessingMotion ClosingMotion DetectingMotion LookingMotion MoveGripperMotion MoveMotion MoveTCPMotion"
        " OpeningMotion WorldStateDetectingMotion"
    )
    for name in table_4_1.split():
        assert issubclass(getattr(pycrorm_async.orm, name), Designator), name
