"""Describe the tables and views of the mapped classes, with their columns in words and with their units.

A column's text comes from the docstring behind its attribute, from the section `Attributes` of its class or of a base,
and from its type: times are integers in SQL, so their text has their unit. Run as a program, it writes the columns of
the built-in tables and the comments on their views, `projections/schema.json`, from these classes.
"""

import ast
import inspect
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import msgspec
from sqlalchemy import Table

from pycrorm_async.orm.base import EPISODE, Base, JsonText, UtcTime, is_built_in, view_mappers
from pycrorm_async.orm.rows import Action, Designator, Language, Motion
from pycrorm_async.projections.columns import SCHEMA_FILE, Schema, Storage
from pycrorm_async.projections.mapped_tables import column_storage, leaves_of

_TIME = "µs since 1970-01-01 00:00 UTC"
_UNIT = re.compile(r"(?:^|, | in )(m|rad|s|kg|ns)(?=[,;:]|$)")
"""The unit in the text of a column, as in `of the robot, m` and `s; null while it runs`."""
_ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.*)$")
_OF_LOADING = re.compile(r"[Ll]oaded|load them|awaitable_attrs|selectinload|undefer|[Ll]ikewise|has the field instead")
_KINDS = (Action, Motion, Language)
"""Classes whose views also have the columns of `designator`, which their own tables do not declare."""
_ALIKE = ("sequence", "end_sequence", "duration", "duration_s", "start_ns", "end_ns")
"""Columns whose text is always that of `_USUAL`, even if their attribute has a docstring."""
_USUAL = {
    "id": "of the row; computed from the episode's number, its event and a slot",
    EPISODE: "number of the episode, `process_metadata.id`",
    "sequence": "the event that made the row: 1, 2, 3 … inside the episode",
    "end_sequence": "the event of its end; null while it runs",
    "dtype": "the designator's type, such as PickUpAction",
    "lineage": "the type, its bases, and Action, Motion or Language",
    "parameters": "the recorded parameters, as JSON",
    "parent_id": "the node around it",
    "node_id": "the node that did it",
    "pose_id": "its row in `pose`",
    "object_id": "its row in `object`, as the object was then",
    "identity_id": "the object's first row, which all its rows share",
    "duration_s": "s; by the robot's monotonic clock; null while it runs, and if it is LOST",
    "duration": "s; the former name of duration_s",
    "start_ns": "ns of the robot's monotonic clock at the start",
    "end_ns": "ns of the robot's monotonic clock at the end",
    "ns": "ns of the robot's monotonic clock",
    "torso_height": "m",
    "frame": "the frame of the pose, such as map",
    **dict.fromkeys("xyz", "m"),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), "of a unit quaternion"),
}


@dataclass(frozen=True)
class ViewDescription:
    """A view in words.

    Attributes:
        name: of the view.
        mapped: name of the mapped class.
        text: the first paragraph of the class's docstring, on one line.
        columns: text by column; a column without one is left out. May also describe columns that the view lacks.
        references: the column that a column refers to, such as `pose.id`, by column.
        built_in: whether every memory has the view.
    """

    name: str
    mapped: str
    text: str
    columns: dict[str, str]
    references: dict[str, str]
    built_in: bool


def described() -> dict[str, ViewDescription]:
    """Return the description of every mapped view of this process, by name."""
    return {name: describe(mapper.class_) for name, mapper in sorted(view_mappers().items())}


def describe(class_: Any) -> ViewDescription:
    """Return the description of a mapped class's view."""
    mapper, table = class_.__mapper__, class_.__table__
    assert isinstance(table, Table)
    texts: dict[str, str] = {}
    for each in reversed(class_.__mro__):
        if issubclass(each, Base) or "__annotations__" in vars(each):
            texts |= _documented(each)
    columns: dict[str, str] = {}
    for column in (*table.columns, *_unmapped(table.name)):
        name = str(column if isinstance(column, str) else column.name)
        kind = None if isinstance(column, str) else column.type
        key = name if isinstance(column, str) else _key_of(mapper, column)
        words = _of_values(texts.get(key) or texts.get(name) or "") if name not in _ALIKE else ""
        words = words or _USUAL.get(name, "")
        parts = [words, _TIME if isinstance(kind, UtcTime) else ""]
        parts += ["JSON"] if isinstance(kind, JsonText) and "JSON" not in words else []
        if text := "; ".join(filter(None, parts)):
            columns[name] = text
    if class_ in _KINDS:
        columns = describe(Designator).columns | columns
    references = {str(column.name): key.target_fullname for column in table.columns for key in column.foreign_keys}
    text = _first_paragraph(class_.__doc__)
    return ViewDescription(table.name, class_.__name__, text, columns, references, is_built_in(class_))


def unit_of(column: Any) -> str:
    """Return the unit of a column of a mapped class, such as m; empty if it has none or none is known."""
    mapped = (each.class_ for each in view_mappers().values() if each.local_table is getattr(column, "table", None))
    class_ = next(mapped, None)
    unit = None if class_ is None else _UNIT.search(describe(class_).columns.get(column.name, ""))
    return "" if unit is None else unit[1]


def _unmapped(view: str) -> Iterable[str]:
    """Return the columns without an attribute that a view may have; not all views have `sequence`."""
    return ("sequence", "parameters", "parent_id") if view == "designator" else ("sequence",)


def _of_values(text: str) -> str:
    """Return the sentences that are about the values, without those about loading attributes in Python."""
    sentences = re.split(r"(?<=[.:;]) (?=[A-Z`])", text)
    text = " ".join(each for each in sentences if not _OF_LOADING.search(each)).rstrip(".:")
    return re.sub(r"\bNone\b", "null", text)


def _key_of(mapper: Any, column: Any) -> str:
    """Return the public name of the attribute that maps a column: without the underscore of a deferred one."""
    key = mapper.get_property_by_column(column).key if column in mapper.columns.values() else column.name
    return str(key).lstrip("_")


def _first_paragraph(doc: str | None) -> str:
    """Return the first paragraph of a docstring, on one line."""
    first = inspect.cleandoc(doc or "").partition("\n\n")[0]
    return " ".join(first.split())


@cache
def _classes_in(module: str) -> dict[str, list[ast.stmt]]:
    """Return the statements of each class of a module; none for one without a file, such as a notebook."""
    try:
        source = inspect.getsource(sys.modules[module])
    except (OSError, TypeError, KeyError):
        return {}
    try:
        tree = ast.parse(source)
    except SystemError:  # Python 3.11 and 3.12 count the recursion of all threads that parse together
        tree = ast.parse(source)
    return {each.name: each.body for each in tree.body if isinstance(each, ast.ClassDef)}


def _documented(class_: type) -> dict[str, str]:
    """Return the texts of a class's attributes, by name."""
    texts: dict[str, str] = {}
    _, _, section = inspect.cleandoc(vars(class_).get("__doc__") or "").partition("Attributes:\n")
    names: list[str] = []
    for line in section.splitlines():
        if entry := _ENTRY.match(line):
            names = entry[1].split(", ")
            texts |= dict.fromkeys(names, entry[2])
        elif line.startswith("        ") and names:
            texts |= {name: f"{texts[name]} {line.strip()}" for name in names}
        elif line.strip():
            break
    for assigned, text in pairwise(_classes_in(class_.__module__).get(class_.__name__, ())):
        match assigned, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                texts[name] = _first_paragraph(words)
    return texts


# === schema ===================================================================================================

_REFERENCES: dict[str, Storage] = {"process_metadata.id": "number", "task_tree_node.id": "row"}


def schema() -> Schema:
    """Return the built-in tables and the texts of their views as the mapped classes declare them."""
    views = {each.name: each for each in described().values() if each.built_in}
    tables = {name: mapper.local_table.columns for name, mapper in view_mappers().items() if name in views}
    indexed = {name: [each.name for each in columns if each.index] for name, columns in sorted(tables.items())}
    indexed = {name: columns for name, columns in indexed.items() if columns}  # a view that computes has no table
    return Schema(
        {name: _columns_of(name) for name in indexed},
        indexed,
        [each for each in leaves_of(Designator) if each.dtype is not None],
        {name: {"": each.text, **each.columns} for name, each in views.items()},
    )


def _columns_of(table: str) -> dict[str, Storage]:
    """Return the columns of a table: those of the class and of those that share its view, as their `info` has them."""
    class_: Any = view_mappers()[table].class_
    storages = {each.name: _storage_of(each) for each in class_.__table__.columns}
    places = {each.name: each.info["after"] for each in class_.__table__.columns if "after" in each.info}
    for name, info in class_._unmapped.items():  # noqa: SLF001  of our own base class
        storages[name], places[name] = info["storage"], info["after"]
    names = [name for name in storages if name not in places]
    for name, before in places.items():
        names.insert(names.index(before) + 1, name)
    return {name: storage for name in names if (storage := storages[name]) is not None}


def _storage_of(column: Any) -> Storage | None:
    """Return the storage of a column in the table behind its view; None if the view computes the column."""
    if "storage" in column.info:
        storage: Storage | None = column.info["storage"]
        return storage
    if column.primary_key:
        return "key"
    references = (_REFERENCES[key.target_fullname] for key in column.foreign_keys if key.target_fullname in _REFERENCES)
    return next(references, "json" if isinstance(column.type, JsonText) else column_storage(column))


if __name__ == "__main__":  # `python -m pycrorm_async.orm.documentation`, after a docstring or a column has changed
    import pycrorm_async.orm.views  # noqa: F401  maps the views, which no other module imports

    SCHEMA_FILE.write_bytes(msgspec.json.format(msgspec.json.encode(schema()), indent=1) + b"\n")
