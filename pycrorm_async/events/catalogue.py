"""Which designator types an episode's log refers to: a fold gets this as an argument and needs no user code.

Declarations are named by fingerprint. One dtype may have several (a field was added, two processes differ): its columns
unite, first declared first; a column declared with two types is a contradiction, which parks the episode that
brought it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from pycrorm_async.events.codec import declaration_of, fingerprint
from pycrorm_async.events.happenings import DesignatorTypeDeclared, FieldDeclared

__all__ = ["Catalogue", "Contradiction"]


class Contradiction(ValueError):
    """Two declarations of one dtype cannot share a table."""


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
        """The united fields of a dtype. Raises `Contradiction` naming the column and both types."""
        united: dict[str, FieldDeclared] = {}
        for declaration in self.of_dtype(dtype):
            for field in declaration.fields:
                known = united.setdefault(field.name, field)
                if (known.type, known.item) != (field.type, field.item):
                    raise Contradiction(
                        f"{dtype}.{field.name} is declared as {known.type} and as {field.type}"
                        " (types that share a name must agree: rename one field or set another dtype)"
                    )
        return tuple(united.values())

    def descendants_of(self, dtype: str) -> tuple[str, ...]:
        """The dtypes whose classes descend from that of `dtype`."""
        return tuple(dict.fromkeys(each.dtype for each in self._declarations.values() if dtype in each.bases))
