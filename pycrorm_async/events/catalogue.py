"""Which designator types an episode's log refers to: a fold gets this as an argument and needs no user code.

Declarations are named by fingerprint. One dtype may have several (a field was added, two processes differ): its columns
unite; a declaration that would give a column another type contradicts the ones before it, and is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from pycrorm_async.events.codec import declaration_of, fingerprint
from pycrorm_async.events.happenings import DesignatorTypeDeclared, FieldDeclared

__all__ = ["Catalogue"]


class Catalogue(Mapping[str, DesignatorTypeDeclared]):
    """Declarations by fingerprint. Immutable: `with_payloads` gives a larger one.

    >>> Catalogue().with_payloads([b'{"kind":"action","dtype":"SayingAction","table":"saying_action"}']).dtypes()
    ('SayingAction',)
    """

    def __init__(self, declarations: Mapping[str, DesignatorTypeDeclared] | None = None) -> None:
        self._declarations = dict(declarations or {})

    def __getitem__(self, name: str) -> DesignatorTypeDeclared:
        return self._declarations[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._declarations)

    def __len__(self) -> int:
        return len(self._declarations)

    def with_payloads(self, payloads: Iterable[bytes]) -> Catalogue:
        """This and the declarations in these payloads."""
        return Catalogue(self._declarations | {fingerprint(each): declaration_of(each) for each in payloads})

    def dtypes(self) -> tuple[str, ...]:
        """Every dtype, in the order of first declaration."""
        return tuple(dict.fromkeys(each.dtype for each in self._declarations.values()))

    def of_dtype(self, dtype: str) -> tuple[DesignatorTypeDeclared, ...]:
        """Every declaration of this dtype, in the order they came."""
        return tuple(each for each in self._declarations.values() if each.dtype == dtype)

    def fields_of(self, dtype: str) -> tuple[FieldDeclared, ...]:
        """The united fields of a dtype, without those of a declaration that contradicts an earlier one."""
        united: dict[str, FieldDeclared] = {}
        for declaration in self.of_dtype(dtype):
            if all(_agree(field, united.get(field.name, field)) for field in declaration.fields):
                for field in declaration.fields:
                    united.setdefault(field.name, field)
        return tuple(united.values())


def _agree(one: FieldDeclared, other: FieldDeclared) -> bool:
    """Whether both fit into one column; members of an enum are stored as text."""
    kinds = {each.type if each.type != "enum" else "text" for each in (one, other)}
    return len(kinds) == 1 and one.item == other.item
