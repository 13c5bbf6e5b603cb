"""The layout of tables: what declarations add, which are refused, and the names of the tables behind the views."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest
from msgspec.structs import replace
from sqlalchemy import select

from pycrorm_async import Reading
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import PickUpAction, TaskTreeNode
from pycrorm_async.projections import projector
from pycrorm_async.projections.columns import Layout, LayoutConflict, LeafTable
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.views import public_views
from tests.databases import ask
from tests.golden.definitions import FILE, changed
from tests.projections.event_script import PICK_UP, SAYING, append_and_fold, declared, field
from tests.projections.rebuild_cases import TYPES, picking, traces
from tests.projections.verify_cases import assert_clean, verified
from tests.table_comparison import differences, tables_of

# === layout ===================================================================================================
#
# The layout of tables: what declarations add, and which declarations are refused.


def layout_of(*types: DesignatorTypeDeclared) -> Layout:
    layout = Layout()
    for each in types:
        layout = layout.with_declaration(each)
    return layout


def test_a_table_with_a_contradicting_column_of_an_authors_class_cannot_join_the_type() -> None:
    layout = layout_of(SAYING).with_leaves([LeafTable("ORMSaying", {"text": "real"})])
    with pytest.raises(LayoutConflict, match=r"SayingAction\.text is declared as text and as real"):
        layout.with_declaration(declared("SayingAction", "ORMSaying", field("volume", "real", 2)))
    assert layout.with_declaration(SAYING) == layout


def test_a_view_lists_all_tables_of_its_type_and_of_its_descendants() -> None:
    careful = declared("CarefulPickUpAction", "careful", bases=("PickUpAction",))
    gentle = declared("GentlePickUpAction", "gentle", bases=("CarefulPickUpAction", "PickUpAction"))
    other_name = declared("PickUpAction", "ORMPickUp")
    layout = layout_of(gentle, careful, PICK_UP, other_name)
    assert layout.members("pick_up_action") == ("pick_up_action", "gentle", "careful", "ORMPickUp")
    assert layout.members("careful") == ("careful", "gentle")
    assert layout.members("gentle") == ("gentle",)


def test_a_lineage_names_the_type_its_tables_and_its_bases_and_ends_with_an_existing_class() -> None:
    careful = declared("CarefulPickUpAction", "careful", bases=("PickUpAction",))
    layout = layout_of(PICK_UP, careful, SAYING, declared("MoveMotion", "move_motion", kind="motion"))
    assert layout.lineage("SayingAction") == "SayingAction Action"
    assert layout.lineage("MoveMotion") == "MoveMotion Motion"
    assert layout.lineage("CarefulPickUpAction") == "CarefulPickUpAction careful PickUpAction Action"


def test_mapped_classes_add_missing_columns_and_never_change_declared_ones() -> None:
    layout = layout_of(SAYING).with_leaves(
        [
            LeafTable("saying_action", {"text": "integer", "volume": "real"}, "SayingAction", "action"),
            LeafTable("ORMLog", {}),
        ]
    )
    assert layout.leaves == {"saying_action": {"text": "text", "volume": "real"}, "ORMLog": {}}
    assert layout.types["SayingAction"].tables == ("saying_action",)


# --- renamed types ----------------------------------------------------------------------------------------------------

GREET = declared("GreetAction", "greet_action", field("whom", "text", 2), field("loud", "boolean", 3))
WELCOME = replace(
    declared("WelcomeAction", "welcome_action", field("whom", "text", 2), field("language", "text", 3)),
    aliases=("GreetAction",),
)
HELLO = replace(declared("HelloAction", "hello_action", field("whom", "text", 2)), aliases=("WelcomeAction",))
LOUD = declared("LoudGreetAction", "loud_greet_action", bases=("GreetAction",))


@pytest.mark.parametrize("order", list(permutations([GREET, WELCOME, HELLO, LOUD])))
def test_a_type_and_its_former_name_are_one_type_whichever_was_declared_first(
    order: tuple[DesignatorTypeDeclared, ...],
) -> None:
    layout = layout_of(*order)
    assert layout_of(*order, *order) == layout
    assert layout.renamed == {"GreetAction": "HelloAction", "WelcomeAction": "HelloAction"}
    assert set(layout.types) == {"HelloAction", "LoudGreetAction"}
    assert set(layout.types["HelloAction"].tables) == {"greet_action", "welcome_action", "hello_action"}
    for table in ("greet_action", "welcome_action", "hello_action"):
        assert layout.members(table)[0] == table
        assert set(layout.members(table)) == {"greet_action", "welcome_action", "hello_action", "loud_greet_action"}
        assert layout.columns(table) == {"whom": "text", "loud": "boolean", "language": "text"}
    assert layout.members("loud_greet_action") == ("loud_greet_action",)
    for name in ("GreetAction", "WelcomeAction", "HelloAction"):
        lineage = layout.lineage(name).split()
        assert (lineage[0], lineage[-1]) == ("HelloAction", "Action")
        assert {"GreetAction", "WelcomeAction", "greet_action", "welcome_action"} < set(lineage)
    assert layout.lineage("LoudGreetAction").split()[:2] == ["LoudGreetAction", "HelloAction"]


def test_a_former_name_that_two_types_claim_belongs_to_the_first() -> None:
    bow = replace(declared("BowAction", "bow_action"), aliases=("GreetAction",))
    layout = layout_of(GREET, WELCOME)
    with pytest.raises(LayoutConflict, match="so BowAction cannot have the alias GreetAction: remove it"):
        layout.with_declaration(bow)
    # A type that names both continues both.
    both = layout.with_declaration(replace(bow, aliases=("GreetAction", "WelcomeAction")))
    assert both.renamed == {"GreetAction": "BowAction", "WelcomeAction": "BowAction"}


def test_a_new_type_changes_only_the_views_that_show_its_rows() -> None:
    shouting = declared("ShoutingAction", "shouting_action", field("volume", "real", 2), bases=("SayingAction",))
    telling = declared("TellingAction", "telling_action", field("text", "text", 2))
    before = layout_of(SAYING, PICK_UP)

    def changed(after: Layout) -> set[str]:
        present = public_views(before)
        return {name for name, view in public_views(after).items() if present.get(name) != view}

    assert changed(before.with_declaration(telling)) == {"telling_action"}
    assert changed(before.with_declaration(shouting)) == {"shouting_action", "saying_action", "designator"}


@pytest.mark.slow
def test_a_changed_table_or_view_is_noticed_and_a_changed_table_raises_the_version() -> None:
    before = FILE.read_text().splitlines()
    tables = {each for each in changed(before) if each.startswith("table ")}
    assert not tables or "version" in changed(before), f"raise PROJECTION_VERSION: {tables} changed"
    assert changed(before) == set(), "run python -m tests.golden.definitions"


# === table names ==============================================================================================
#
# The tables behind the views come last in a list of names, and tables with former names are used until a rebuild.


@pytest.mark.slow
async def test_the_tables_of_a_generation_come_last_in_a_list_of_names(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, [*TYPES, *picking(1).records])
    for generation in (1001, 1002):
        listed = ask(url, "SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')")
        behind = {name for name, kind in listed if kind == "table" and name.endswith(f"__{generation}")}
        assert len(behind) > 40
        for names in (sorted(name for name, _ in listed), sorted((name for name, _ in listed), key=str.lower)):
            assert set(names[-len(behind) :]) == behind
        await rebuild_memory(url, views=[UserView("zoom_all", select(TaskTreeNode.id))])


@pytest.mark.soak_on("postgresql")
@pytest.mark.empty_database
@pytest.mark.slow
async def test_tables_with_former_names_are_used_until_a_rebuild_replaces_them(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(projector, "next_number", lambda _numbers: 7)
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    await append_and_fold(database_url, picking(2).records)
    at = "memory_tables." if database_url.startswith("postgresql:") else ""
    assert ask(database_url, f"SELECT count(*) FROM {at}pose__7")[0][0] > 0
    async with Reading.open(database_url) as reading, reading.session() as session:
        assert len((await session.scalars(select(PickUpAction.id))).all()) == 10
    assert_clean(await verified(database_url))
    before = tables_of(database_url)
    assert (await rebuild_memory(database_url)).generation == 1001
    assert differences(before, tables_of(database_url)) == []
    assert traces(database_url) == []
    assert ask(database_url, f"SELECT count(*) FROM {at}zz_pose__1001")[0][0] > 0
    assert_clean(await verified(database_url))
