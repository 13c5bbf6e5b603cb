"""The views of a memory in words: every column of a time has its unit, and a diagram shows what refers to what."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm.base import Base, UtcTime
from pycrorm_async.orm.documentation import described
from pycrorm_async.orm.documentation import schema as declared_schema
from pycrorm_async.projections.columns import SCHEMA
from pycrorm_async.query.memory_schema import CORE_VIEWS, as_text, read_schema
from pycrorm_async.query.reading import Reading
from tests.commands import pycrorm
from tests.databases import Server, ask, run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, append_and_fold, declarations
from tests.query.test_reading import episode

README = Path(__file__).parents[2] / "pycrorm_async/query/README.md"


@pytest.fixture(scope="module")
def filled_url(module_database_url: str) -> str:
    records = [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(1).records]
    run_in_own_loop(append_and_fold(module_database_url, records))
    return module_database_url


def test_every_column_of_a_time_has_its_unit_and_every_built_in_view_a_sentence() -> None:
    views = described()
    for name, table in Base.metadata.tables.items():
        assert views[name].text, name
        for column in table.columns:
            if isinstance(column.type, UtcTime):
                assert views[name].columns[column.name].endswith("µs since 1970-01-01 00:00 UTC"), (name, column.name)
            if column.name.endswith("_ns"):
                assert views[name].columns[column.name].startswith("ns of"), (name, column.name)


async def test_a_memory_describes_all_of_its_views(reading: Reading) -> None:
    schema = {each.name: each for each in await read_schema(reading)}
    assert {*CORE_VIEWS, "saying_action", "PickUpWithContextView"} <= schema.keys()
    assert schema["saying_action"].text.startswith("Parameters of SayingAction; `id` is that of its row in action")
    assert {each.name for each in schema["saying_action"].columns} == {"id", "process_metadata_id", "sequence", "text"}
    pick_up = {each.name: each.refers_to for each in schema["pick_up_action"].columns}
    assert (pick_up["id"], pick_up["object_designator_id"]) == ("action.id", "object.id")
    assert not [name for name in schema if name.startswith(("zz_", "pycrorm_"))]
    text = as_text([schema["pose"]])
    assert text.startswith("pose (Pose): A position (m) and an orientation (unit quaternion)")
    assert "\n  time bigint  µs since 1970-01-01 00:00 UTC" in text


@pytest.mark.soak_on("postgresql")
async def test_a_view_that_does_not_exist_is_answered_with_the_nearest(reading: Reading) -> None:
    with pytest.raises(CallerError, match=r"^this memory has no view 'actions'; did you mean action"):
        await read_schema(reading, ["pose", "actions"])


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
def test_the_command_prints_text_json_and_a_diagram(filled_url: str, tmp_path: Path) -> None:
    url = filled_url
    done = pycrorm("schema", "pose", "--json", "--url", url, cwd=tmp_path)
    [pose] = json.loads(done.stdout)
    assert (pose["mapped"], pose["columns"][0]["name"]) == ("Pose", "id")
    diagram = pycrorm("schema", "--format", "mermaid", "--url", url, cwd=tmp_path).stdout
    assert diagram.startswith("erDiagram\n    process_metadata {\n")
    assert "    object }o--|| pose : pose_id\n" in diagram
    wrong = pycrorm("schema", "posse", "--url", url, cwd=tmp_path)
    assert (wrong.returncode, wrong.stderr) == (2, "pycrorm: this memory has no view 'posse'; did you mean pose?\n")


def test_the_file_with_tables_and_comments_is_that_of_the_mapped_classes() -> None:
    assert declared_schema() == SCHEMA, "run python -m pycrorm_async.orm.documentation"


def commented(url: str) -> dict[tuple[str, str], str]:
    """Return the comments in the database by view and column."""
    rows = ask(
        url,
        "SELECT relname, coalesce(attname, ''), description FROM pg_description JOIN pg_class ON pg_class.oid = objoid"
        " LEFT JOIN pg_attribute ON attrelid = objoid AND attnum = objsubid AND attnum > 0"
        " WHERE classoid = 'pg_class'::regclass AND relnamespace = 'memory'::regnamespace",
    )
    return {(view, column): text for view, column, text in rows}


@pytest.mark.slow
def test_postgresql_keeps_the_texts_as_comments_also_after_new_types_and_a_rebuild(server: Server) -> None:
    url = server.new_database()
    run_in_own_loop(append_and_fold(url, [*declarations(NAVIGATE, PICK_UP), *episode(1).records[:3]]))
    first = commented(url)
    assert first["pose", "time"] == "µs since 1970-01-01 00:00 UTC"
    assert first["task_tree_node", ""] == "One perform, from its start to its end."
    assert len(first) > 400
    run_in_own_loop(append_and_fold(url, [*declarations(SAYING), *episode(2).records]))
    assert commented(url) == first
    run_in_own_loop(rebuild_memory(url, workers=1))
    assert commented(url) == first
