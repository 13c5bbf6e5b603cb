"""`KnownTypes` holds the field types of all designator types that one memory has declared."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldDeclared

__all__ = ["KnownTypes", "type_text"]


class KnownTypes:
    """The declared types of one memory. A field of one dtype has one type in all its declarations.

    Args:
        built_in: returns the declaration of the plan layer's own type with this dtype; None if it has none.
    """

    def __init__(self, built_in: Callable[[str], DesignatorTypeDeclared | None]) -> None:
        self.built_in = built_in
        self._fields_by_dtype: dict[str, dict[str, str]] = {}
        self._dtype_by_table: dict[str, str] = {}

    def fields_of(self, dtype: str) -> Mapping[str, str]:
        """Return the types of the fields of a dtype as declared so far, as `type_text` describes them."""
        return self._fields_by_dtype.get(dtype, {})

    def dtype_of(self, table: str) -> str | None:
        """Return the dtype that has this table; None if none has it."""
        return self._dtype_by_table.get(table)

    def note(self, declaration: DesignatorTypeDeclared) -> None:
        """Note a declaration."""
        self._dtype_by_table.setdefault(declaration.table, declaration.dtype)
        self._fields_by_dtype.setdefault(declaration.dtype, {}).update(
            (each.name, type_text(each)) for each in declaration.fields
        )


def type_text(field: FieldDeclared) -> str:
    """Describe a field's type; an enum counts as text, because its members are stored as text."""
    return f"{'text' if field.type == 'enum' else field.type}{f' of {field.item}' if field.item else ''}"
