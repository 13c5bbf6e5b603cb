"""Import logs of BehaviorTree.CPP 4: the `.btlog` of its FileLogger2 and of Groot 2, the `.db3` of its SqliteLogger.

A log is an episode; a `.db3` has one for each of its sessions. An activation of a node of the tree, from the tick that
starts it until it is not RUNNING any more, is a node of the episode: `language` for controls, decorators and subtrees,
else `action`. SUCCESS is SUCCEEDED, FAILURE is FAILED, and a node that is halted ends INTERRUPTED. The ports of a node
are its parameters, as texts: an entry of the blackboard by its name, because the log does not have the values.

A condition that answers the same in every tick is recorded once below each activation of its parent.

The format of a `.btlog`, from the source of BehaviorTree.CPP 4.6: `BTCPP4-FileLogger2`, a byte with the protocol (1),
the length of the XML (int32), the XML of the tree, the time of the start (int64, µs since 1970), and for each
transition 9 bytes: µs since the start (48 bits), the id of the node (uint16), and its new status; all little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Final, Literal, NamedTuple
from xml.etree import ElementTree as ET

from pycrorm_async.imports import intake as intakes
from pycrorm_async.imports.intake import Intake, IntakeEpisode, identity_of

_MAGIC: Final = b"BTCPP4-FileLogger2"
_SQLITE: Final = b"SQLite format 3\0"
_IDLE, _RUNNING, _SUCCESS, _FAILURE, _SKIPPED = range(5)
_TRANSITION = struct.Struct("<IHHB")
_PAGE = 10_000
"""Bounds the transitions that are read at once."""
_UID_DIGITS = 5
"""Bounds the digits of an id, which has 16 bits in a transition."""
_NEGATIVE = 2**47
"""Offsets of 48 bits from here on are negative: the clock was set back."""
_CONTROLS = ("Control", "Decorator", "SubTree")


class _TreeNode(NamedTuple):
    """A node of a tree; `parent` is the id of its parent, None for the root."""

    dtype: str
    kind: Literal["action", "language"]
    parameters: Mapping[str, str]
    parent: int | None
    is_condition: bool


def read_btlog(path: Path, settings: intakes.MapFile, intake: Intake) -> None:  # noqa: ARG001  has no keys of its own
    """Give the episodes of a log to the intake. Raises `WrongFormat`."""
    if path.is_dir():
        raise intakes.WrongFormat(f"{path} is a folder: name the .btlog files in it")
    with path.open("rb") as file:
        magic = file.read(len(_MAGIC))
    if magic.startswith(_SQLITE):
        _read_sessions(path, intake)
    elif magic == _MAGIC:
        _read_file(path, intake)
    else:
        raise intakes.WrongFormat(f"{path} is no log of BehaviorTree.CPP 4, which begins with {_MAGIC.decode()}")


FORMAT = intakes.ImportFormat(
    read_btlog, "logs of BehaviorTree.CPP 4 and Groot 2: .btlog, or the .db3 of its SqliteLogger"
)

# === files ====================================================================================================


def _read_file(path: Path, intake: Intake) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(len(_MAGIC))
        header = file.read(5)
        length = int.from_bytes(header[1:], "little", signed=True)
        content = file.read(max(length, 0)) if len(header) == 5 else b""
        start = file.read(8)
        if header[:1] not in (b"", b"\1"):
            raise intakes.WrongFormat(f"{path} has the protocol {header[0]}, and this version reads 1")
        if len(start) < 8:
            intake.cut(path, "ends before its first transition: nothing of it is imported")
            return
        begin_us = int.from_bytes(start, "little", signed=True)
        nodes = _nodes_of(path, content.decode(errors="replace"))

        def transitions() -> Iterator[tuple[int, int, int]]:
            while page := file.read(_TRANSITION.size * _PAGE):
                intake.progress(file.tell(), size)
                whole = len(page) - len(page) % _TRANSITION.size
                for low, high, uid, status in _TRANSITION.iter_unpack(page[:whole]):
                    offset = high << 32 | low
                    yield begin_us + (offset if offset < _NEGATIVE else offset - 2 * _NEGATIVE), uid, status

        _give(path, identity_of(path), nodes, begin_us, transitions(), intake)
        rest = (size - len(_MAGIC) - 13 - length) % _TRANSITION.size
    if rest:
        intake.cut(path, f"ends in the middle of a transition: its last {rest} bytes are left out")


def _read_sessions(path: Path, intake: Intake) -> None:
    identity = identity_of(path)
    select = "SELECT timestamp, node_uid, state FROM Transitions WHERE session_id = ? ORDER BY timestamp"
    with intakes.opened_database(path) as database:
        try:
            sessions = database.execute("SELECT session_id, xml_tree FROM Definitions ORDER BY session_id").fetchall()
        except intakes.DATABASE_ERRORS as error:
            raise intakes.WrongFormat(f"{path} is no log of BehaviorTree.CPP 4: {error}") from None

        def transitions(session: int) -> Iterator[tuple[int, int, int]]:
            try:
                for row in database.execute(select, (session,)):
                    if all(isinstance(each, int) for each in row):
                        yield row
                    else:
                        intake.left_out("transitions", "their time, node or status is no whole number")
            except intakes.DATABASE_ERRORS as error:
                intake.cut(path, f"cannot be read to its end: {error}")

        for session, xml in sessions:
            rows = transitions(session)
            first = next(rows, None)
            if first is None:
                intake.left_out("sessions", "they have no transitions")
            else:
                _give(path, f"{identity}-{session}", _nodes_of(path, str(xml)), first[0], chain([first], rows), intake)


def _nodes_of(path: Path, xml: str) -> dict[int, _TreeNode]:
    """Return the nodes of a tree by their ids. Raises `WrongFormat`."""
    if "<!DOCTYPE" in xml or "<!ENTITY" in xml:  # entities could make a small file huge
        raise intakes.WrongFormat(f"{path} has a tree with a document type, which BehaviorTree.CPP does not write")
    try:
        root = ET.fromstring(xml.strip("\0"))  # noqa: S314  it has no entities
    except ET.ParseError as error:
        raise intakes.WrongFormat(f"{path} has a tree that is no XML: {error}") from None
    kinds = {str(each.get("ID")): each.tag for model in root.iter("TreeNodesModel") for each in model}
    trees = [each for each in root if each.tag == "BehaviorTree"]
    left = {id(each): each for each in trees[1:]}
    nodes: dict[int, _TreeNode] = {}

    def subtree_of(element: ET.Element) -> ET.Element | None:
        fitting = [each for each in left.values() if each.get("ID") == element.get("ID")]
        exact = [each for each in fitting if each.get("_fullpath") == element.get("_fullpath")]
        return left.pop(id((exact or fitting)[0])) if fitting else None

    stack: list[tuple[ET.Element, int | None]] = [(each, None) for each in (trees[0] if trees else ())]
    while stack:
        element, parent = stack.pop()
        uid = int(text) if (text := element.get("_uid", "")).isdecimal() and len(text) <= _UID_DIGITS else None
        inside = list(element)
        if element.tag == "SubTree" and (below := subtree_of(element)) is not None:
            inside = list(below)
        if uid is not None:
            if uid in nodes:
                raise intakes.WrongFormat(f"{path} has a tree with two nodes of the id {uid}")
            kind = kinds.get(element.tag, element.tag)
            dtype = (element.get("ID") or element.tag) if element.tag == "SubTree" else element.tag
            ports = {name: value for name, value in element.attrib.items() if not name.startswith("_") and name != "ID"}
            is_control = bool(inside) or kind in _CONTROLS
            nodes[uid] = _TreeNode(dtype, "language" if is_control else "action", ports, parent, kind == "Condition")
        stack += [(each, parent if uid is None else uid) for each in reversed(inside)]
    if not nodes:
        raise intakes.WrongFormat(f"{path} has a tree without ids of its nodes")
    return nodes


# === activations ==============================================================================================


def _give(
    path: Path,
    name: str,
    nodes: Mapping[int, _TreeNode],
    begin_us: int,
    transitions: Iterable[tuple[int, int, int]],
    intake: Intake,
) -> None:
    root = next(iter(nodes))
    described = nodes[root].parameters.get("name") or nodes[root].dtype
    metadata = {"file": path.name, "executive": "BehaviorTree.CPP 4"}
    with intake.episode(name, begin_us * 1000, description=f"{described} ({path.name})", metadata=metadata) as episode:
        tree = _Activations(nodes, episode, intake)
        for time_us, uid, status in transitions:
            tree.read(time_us * 1000, uid, status)
        episode.ended({_SUCCESS: "SUCCEEDED", _FAILURE: "FAILED"}.get(tree.outcome.get(root, _IDLE), "UNKNOWN"))


class _Activations:
    """The activations of the nodes of a tree. The key of one is the id of the node; it is open once at a time.

    Attributes:
        outcome: how the last activation of each node ended.
    """

    def __init__(self, nodes: Mapping[int, _TreeNode], episode: IntakeEpisode, intake: Intake) -> None:
        self.outcome: dict[int, int] = {}
        self._nodes, self._episode, self._intake = nodes, episode, intake
        self._begun: dict[int, int] = {}
        self._same: dict[int, tuple[int, int]] = {}

    def read(self, at: int, uid: int, status: int) -> None:
        """Read a transition of a node to a new status."""
        if uid not in self._nodes:
            self._intake.left_out("transitions", "the tree has no node with their id")
        elif status == _RUNNING:
            self._enter(at, uid)
        elif status in (_SUCCESS, _FAILURE):
            self._end(at, uid, status)
        elif status in (_IDLE, _SKIPPED):
            if self._episode.is_open(uid):
                self._episode.end(uid, "INTERRUPTED", at)
            elif status == _SKIPPED:
                self._intake.left_out("nodes that were skipped", "they did nothing")
        else:
            self._intake.left_out("transitions", "BehaviorTree.CPP 4 has no such status")

    def _end(self, at: int, uid: int, status: int) -> None:
        self.outcome[uid] = status
        node = self._nodes[uid]
        if not self._episode.is_open(uid):
            if (
                node.is_condition
                and self._is_open(node.parent)
                and self._same.get(uid) == (self._of(node.parent), status)
            ):
                self._intake.left_out("answers of conditions", "they are the same as before, below the same activation")
                return
            self._enter(at, uid)
        self._same[uid] = self._of(node.parent), status
        failure = None if status == _SUCCESS else f"{node.dtype} returned FAILURE"
        self._episode.end(uid, "SUCCEEDED" if status == _SUCCESS else "FAILED", at, failure=failure)

    def _is_open(self, uid: int | None) -> bool:
        return uid is not None and self._episode.is_open(uid)

    def _of(self, uid: int | None) -> int:
        """Return the number of the activation of a node, 1, 2, 3 …"""
        return self._begun.get(uid, 0) if uid is not None else 0

    def _enter(self, at: int, uid: int) -> None:
        """Start the activation of a node, and first those above it, because only they tick it."""
        path = []
        above: int | None = uid
        while above is not None and not self._episode.is_open(above):
            path.append(above)
            above = self._nodes[above].parent
        for each in reversed(path):
            node = self._nodes[each]
            self._begun[each] = self._of(each) + 1
            self._episode.start(each, node.kind, node.dtype, node.parameters, at, parent=node.parent)
