"""`KnownTypes` holds the field types of all designator types that one memory has declared."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldDeclared

_COLUMNS_MAX = 500
"""Bounds the names of one table, below the columns that the databases allow."""


class KnownTypes:
    """The declared types of one memory. A field of one dtype has one type in all its declarations.

    Args:
        built_in: returns the declaration of the plan layer's own type with this dtype; None if it has none.
    """

    def __init__(self, built_in: Callable[[str], DesignatorTypeDeclared | None]) -> None:
        self._find_built_in = built_in
        self._built_in: dict[str, DesignatorTypeDeclared | None] = {}
        self._fields_by_dtype: dict[str, dict[str, str]] = {}
        self._tables: dict[str, str] = {}
        self._columns: dict[str, dict[str, FieldDeclared]] = {}

    def built_in(self, dtype: str) -> DesignatorTypeDeclared | None:
        """Return the declaration of the plan layer's own type with this dtype; None if it has none.

        Each answer is kept for the life of the memory, because finding that there is none searches all classes.
        """
        if dtype not in self._built_in:
            self._built_in[dtype] = self._find_built_in(dtype)
        return self._built_in[dtype]

    def fields_of(self, dtype: str) -> Mapping[str, str]:
        """Return the types of the fields of a dtype as this memory declared them, as `type_text` describes them."""
        return self._fields_by_dtype.get(dtype, {})

    def fault_in_table(self, table: str, dtype: str) -> str | None:
        """Return the reason why another type has this table; None if none has."""
        owner = self._tables.get(table.lower(), dtype)
        return f"the dtype {owner!r} already has the table {table!r}" if owner != dtype else None

    def fault_in_field(self, field: FieldDeclared, table: str) -> str | None:
        """Return the reason why this field cannot be a column of the table beside all declared ones; None if it can."""
        columns = self._columns.get(table.lower(), {})
        for name in (field.name.lower(), field.column.lower()):
            declared = columns.get(name, field)
            if (declared.name, type_text(declared)) != (field.name, type_text(field)):
                return f"its type is {type_text(field)}, but the table has {declared.name!r} as {type_text(declared)}"
        if len(columns) > _COLUMNS_MAX and field.name.lower() not in columns:
            return f"the table has {_COLUMNS_MAX} columns already"
        return None

    def state_of(self, table: str) -> tuple[str | None, int]:
        """Return the owner of a table and the number of its names; they change with each declaration that adds any."""
        return self._tables.get(table.lower()), len(self._columns.get(table.lower(), ()))

    def copy_of(self, table: str) -> KnownTypes:
        """Return a copy that knows this table alone."""
        copy, name = KnownTypes(self.built_in), table.lower()
        if (owner := self._tables.get(name)) is not None:
            copy._tables[name] = owner
        copy._columns[name] = dict(self._columns.get(name, {}))
        return copy

    def note(self, declaration: DesignatorTypeDeclared) -> None:
        """Note a declaration of this memory."""
        fields = ((each.name, type_text(each)) for each in declaration.fields)
        self._fields_by_dtype.setdefault(declaration.dtype, {}).update(fields)
        self.note_stored(declaration)

    def note_stored(self, declaration: DesignatorTypeDeclared) -> None:
        """Note a declaration, also of another process, whose table and columns the database has."""
        self._tables.setdefault(declaration.table.lower(), declaration.dtype)
        columns = self._columns.setdefault(declaration.table.lower(), {})
        for field in declaration.fields:
            columns.setdefault(field.name.lower(), field)
            columns.setdefault(field.column.lower(), field)


def type_text(field: FieldDeclared) -> str:
    """Describe a field's type; an enum counts as text, because its members are stored as text."""
    return f"{'text' if field.type == 'enum' else field.type}{f' of {field.item}' if field.item else ''}"
