"""Load an attribute of many objects at once, at the first access to one that is not loaded.

A query for a base class, such as `select(Action)`, loads the columns of the base only, and no relationship. The first
time that `arm` of one action is read, the columns of its class are loaded for up to `BATCH` objects of this class in
the session, beginning with that one. A relationship such as `robot_state` is loaded in the same way. So a query for
25,000 actions loads only the attributes that are read, and reading one of each takes 50 queries, not 25,000.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import bindparam, select
from sqlalchemy.orm import (
    InstanceState,
    Mapper,
    ORMExecuteState,
    RelationshipProperty,
    Session,
    load_only,
    selectinload,
)
from sqlalchemy.orm.exc import DetachedInstanceError, ObjectDeletedError

__all__ = ["BATCH", "KEYS", "load_related", "load_columns"]

BATCH = 500
"""Bounds the objects for which one query loads an attribute. SQLAlchemy passes as many keys to a query."""

KEYS = "primary_keys"
"""The parameter in which SQLAlchemy's loads and those of this module pass the ids."""


def load_related(state: ORMExecuteState) -> None:
    """Load a relationship for further objects too, when SQLAlchemy loads it for one: a hook of a session.

    SQLAlchemy's own load follows, and takes the related rows from those that are loaded by then.
    """
    if not state.is_relationship_load:
        return
    loaded, path = state.lazy_loaded_from, state.loader_strategy_path
    if loaded is None or not path or not isinstance(path[-1], RelationshipProperty):
        return
    related = path[-1]
    class_ = related.parent.class_
    peers = _peers(state.session, loaded, class_, related.key)
    if len(peers) > 1:
        _load(state.session, class_, peers, load_only(_key(class_)), selectinload(getattr(class_, related.key)))


def load_columns(state: InstanceState[Any], toload: set[str], passive: Any) -> None:  # noqa: ARG001  SQLAlchemy's
    """Load columns of an object's class that the query for its base did not, and those of further such objects."""
    session = state.session
    if session is None:
        raise DetachedInstanceError(f"{sorted(toload)} of {state.class_.__name__} {state.identity} are not loaded")
    by_class: dict[Any, list[str]] = {}
    for key in sorted(toload.intersection(state.mapper.column_attrs.keys())):
        by_class.setdefault(state.mapper.column_attrs[key].parent.class_, []).append(key)
    for class_, keys in by_class.items():
        _load(
            session, class_, _peers(session, state, class_, *keys), load_only(*(getattr(class_, key) for key in keys))
        )
        if not state.dict.keys() >= set(keys):
            raise ObjectDeletedError(state)


def _peers(session: Session, state: InstanceState[Any], class_: type, *names: str) -> list[InstanceState[Any]]:
    """Return this object and those behind it in the session that lack one of these attributes, at most `BATCH`."""
    states = session.identity_map.all_states()
    position = states.index(state)
    peers = []
    for each in (*states[position:], *states[:position]):
        if issubclass(each.class_, class_) and any(name not in each.dict for name in names) and each.obj() is not None:
            peers.append(each)
            if len(peers) == BATCH:
                break
    return peers


def _load(session: Session, class_: Any, states: list[InstanceState[Any]], *options: Any) -> None:
    rows = [each.obj() for each in states]  # so that no row is collected, and made again, during the load
    keys = sorted({each.identity[0] for each in states if each.identity})
    statement = select(class_).where(_key(class_).in_(bindparam(KEYS, expanding=True))).options(*options)
    session.execute(statement, {KEYS: keys}).unique().all()
    del rows


def _key(class_: Any) -> Any:
    """Return the first attribute of the class's key: the id of its row, or of the row that it belongs to."""
    mapper: Mapper[Any] = class_.__mapper__
    return getattr(class_, mapper.get_property_by_column(mapper.primary_key[0]).key)
