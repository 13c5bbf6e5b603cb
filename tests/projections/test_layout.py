"""The layout of tables: what declarations add, which are refused, and the names of the tables behind the views."""

from __future__ import annotations

from itertools import permutations

import pytest
from msgspec.structs import replace

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.columns import Layout, LayoutConflict, LeafTable
from pycrorm_async.projections.views import public_views
from tests.golden.definitions import FILE, changed
from tests.projections.event_script import PICK_UP, SAYING, declared, field

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
