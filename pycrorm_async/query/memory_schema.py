"""Read the views of a memory with their columns, and add the descriptions from the mapped classes' docstrings.

schema = await read_schema(reading)
print(as_text(schema))
print(as_mermaid(schema))       # a diagram, which GitHub, GitLab, Obsidian and mermaid.live draw
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, inspect
from sqlalchemy.engine.reflection import ObjectKind

from pycrorm_async.errors import CallerError, DatabaseUnavailable
from pycrorm_async.orm import DesignatorType
from pycrorm_async.orm.documentation import ViewDescription, described
from pycrorm_async.projections.generations import current_generation
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest
from pycrorm_async.store.address import no_tables

CORE_VIEWS = (
    "process_metadata",
    "task_tree_node",
    "action",
    "pick_up_action",
    "robot_state",
    "pose",
    "object",
    "root_failure",
    "detection",
    "attachment",
    "joint_change",
    "location_resolution",
    "observation",
    "observation_value",
)
"""The default views of the diagram, which most queries read; the views of all types would fill pages."""


@dataclass(frozen=True)
class ColumnDescription:
    """A column of a view.

    Attributes:
        type: as the database names it; empty where SQLite has none, as for an expression.
        text: its meaning and unit; empty if its name is enough.
        refers_to: the column whose value it has, such as `pose.id`.
    """

    name: str
    type: str
    text: str = ""
    refers_to: str | None = None


@dataclass(frozen=True)
class View:
    """A view of a memory.

    Attributes:
        mapped: name of the mapped class; None if there is none.
    """

    name: str
    text: str
    mapped: str | None
    columns: tuple[ColumnDescription, ...]


async def read_schema(reading: Reading, names: Sequence[str] = ()) -> list[View]:
    """Return the views of a memory by name, or those named. Raises `CallerError` for a view that does not exist."""
    log = await reading.log()
    with log.translated():
        async with log.engine.connect() as connection:
            generation = await current_generation(connection)
            columns = await connection.run_sync(_columns)
    if generation is None:
        raise DatabaseUnavailable(no_tables(log.address))
    present = sorted(generation.views.keys() & columns.keys())
    for name in names:
        if name not in present:
            raise CallerError(f"this memory has no view {name!r}{nearest(name, present)}")
    types = {row.leaf: row.dtype for row in await reading.rows(_TYPES)}
    texts = described()
    return [_view(name, columns[name], texts.get(name), types.get(name)) for name in (names or present)]


_TYPES: Any = DesignatorType.__table__.select()


def _columns(connection: Connection) -> dict[str, list[tuple[str, str]]]:
    of_views = inspect(connection).get_multi_columns(kind=ObjectKind.VIEW)
    return {
        name: [(each["name"], _type_text(each["type"])) for each in columns] for (_, name), columns in of_views.items()
    }


def _type_text(kind: Any) -> str:
    text = str(kind).lower()
    return "" if text == "null" else text


def _view(name: str, columns: Iterable[tuple[str, str]], words: ViewDescription | None, dtype: str | None) -> View:
    if words is None:
        text = f"Parameters of {dtype}; `id` is that of its row in action, motion or language." if dtype else ""
        return View(name, text, None, tuple(ColumnDescription(*each) for each in columns))
    described_columns = (
        ColumnDescription(each, kind, words.columns.get(each, ""), words.references.get(each)) for each, kind in columns
    )
    return View(name, words.text, words.mapped, tuple(described_columns))


def as_text(views: Iterable[View]) -> str:
    """Return a paragraph for each view: its name and class, what a row is, and its columns with type and meaning."""
    return "\n\n".join("\n".join(_lines(each)) for each in views)


def _lines(view: View) -> Iterable[str]:
    yield f"{view.name}{f' ({view.mapped})' if view.mapped else ''}{f': {view.text}' if view.text else ''}"
    for each in view.columns:
        refers = f" -> {each.refers_to}" if each.refers_to else ""
        text = f"  {each.text}" if each.text else ""
        yield f"  {each.name} {each.type}{refers}{text}".rstrip()


def as_mermaid(views: Sequence[View]) -> str:
    """Return an entity-relationship diagram in Mermaid's language; lines lead to the views that columns refer to."""
    names = {each.name for each in views}
    lines = ["erDiagram"]
    for view in views:
        lines.append(f"    {view.name} {{")
        for each in view.columns:
            key = " PK" if each.name == "id" else " FK" if each.refers_to else ""
            lines.append(f"        {(each.type or 'any').replace(' ', '_')} {each.name}{key}")
        lines.append("    }")
    for view in views:
        for each in view.columns:
            other = (each.refers_to or "").partition(".")[0]
            if other in names and each.name != "id":
                lines.append(f"    {view.name} }}o--|| {other} : {each.name}")
    return "\n".join(lines)
