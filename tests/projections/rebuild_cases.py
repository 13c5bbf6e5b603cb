"""Cases for a rebuild: episodes, the same log folded elsewhere, and the traces that a rebuild must not leave."""

from __future__ import annotations

from pathlib import Path

from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    NodeEnded,
    NodeReference,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
    RobotValue,
)
from tests.databases import ask
from tests.projections.event_script import (
    PICK_UP,
    SAYING,
    Script,
    append_and_fold,
    declarations,
    declared,
    field,
    name_of,
    pose,
)
from tests.table_comparison import Tables, tables_of

TYPES = declarations(PICK_UP, SAYING)
WHISPERING = declared("WhisperingAction", "whispering_action", field("text", "text", 2), field("soft", "real", 3))
"""A type that is declared later."""


def picking(number: int, *, nodes: int = 5, simulated: bool = False) -> Script:
    """Return an episode of pick-ups below a root, of which every third fails."""
    script = Script(number)
    thought_by = NodeReference(str_of(number - 1), 2) if simulated else None
    script.put(EpisodeStarted(f"e{number}", "me", "h", "0", "3", simulated=simulated, thought_by=thought_by))
    root = script.put(NodeStarted("root", simulated=simulated))
    milk = script.put(ObjectAdded("milk", "MILK", pose(number, 2, 0.9)))
    for turn in range(nodes):
        robot = RobotValue(pose(0.25, turn), "ROBOT", 0.3)
        parameters = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
        node = script.put(NodeStarted("action", root, name_of(PICK_UP), parameters, robot, simulated))
        failure = FailureValue("a.IKError", "far") if turn % 3 == 2 else None
        script.put(NodeEnded(node, "FAILED" if failure else "SUCCEEDED", failure))
    script.put(NodeEnded(root, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return script


def str_of(number: int) -> str:
    """Return the UUID of the episode with this number as text."""
    return f"00000000-0000-7000-8000-{number:012x}"


def lost(number: int) -> Script:
    """Return an episode that recovery ended in the middle of a node."""
    script = Script(number)
    script.records = picking(number).records[:6]
    script.put_payload(EpisodeEnded.__name__, LOST)
    return script


def parking(number: int) -> Script:
    """Return an episode with a node, one of a type that was never declared, and another node."""
    script = Script(number)
    script.put(EpisodeStarted(f"e{number}", "me", "h", "0", "3"))
    script.put(NodeStarted("root"))
    script.put(NodeStarted("action", 2, "0" * 64, {}))
    script.put(NodeStarted("action", 2, name_of(SAYING), {"text": "never shown"}))
    return script


def whispering(number: int) -> list[Record]:
    script = Script(number)
    script.put(EpisodeStarted(f"e{number}", "me", "h", "0", "3"))
    script.put(NodeStarted("action", None, name_of(WHISPERING), {"text": "psst", "soft": 0.1 + number}))
    return [*declarations(WHISPERING), *script.records]


async def folded_elsewhere(url: str, folder: Path) -> Tables:
    """Return the expected tables: the same log, folded into a new database without a rebuild."""
    other = f"sqlite:///{folder}/elsewhere.db"
    types = "SELECT payload FROM pycrorm_declaration ORDER BY ordinal"
    records = [
        Record(position, None, 0, "DesignatorTypeDeclared", 1, 0, 0, payload.encode())
        for position, (payload,) in enumerate(ask(url, types), 1)
    ]
    events = "SELECT id, sequence, type, version, wall_ns, monotonic_ns, payload FROM episode JOIN event"
    for identity, sequence, kind, version, wall_ns, monotonic_ns, payload in ask(
        url, f"{events} ON episode = number ORDER BY number, sequence"
    ):
        episode = parse_episode_id(identity)
        position = len(records) + 1
        records.append(Record(position, episode, sequence, kind, version, wall_ns, monotonic_ns, payload.encode()))
    await append_and_fold(other, records)
    return tables_of(other)


def traces(url: str) -> list[str]:
    """Return what is useless after a rebuild: tables of another generation, notes, replaced views, a file beside the
    database. The cases have tables and a generation of their own.
    """
    at = "memory_tables." if url.startswith("postgresql:") else ""
    notes = [name for (name,) in ask(url, f"SELECT projection FROM {at}pycrorm_generation")]
    [(current,)] = ask(url, f"SELECT generation FROM {at}pycrorm_generation WHERE projection = 'tables'")
    listed = (
        "SELECT relname FROM pg_class WHERE relkind IN ('r', 'p') AND NOT relispartition"
        " AND relnamespace = 'memory_tables'::regnamespace"
        if at
        else "SELECT name FROM sqlite_master WHERE type = 'table'"
    )
    tables = [name for (name,) in ask(url, listed)]
    cases = f"SELECT generation FROM {at}pycrorm_generation WHERE projection = 'projection/recall'"
    made = ("pycrorm_own_recall_block", "pycrorm_progress_recall")
    of_cases = {f"zz_{table}__{number}" for (number,) in ask(url, cases) for table in made}
    tables = [each for each in tables if each not in of_cases]
    traces_left = [each for each in notes if each not in ("tables", "projection/recall")]
    traces_left += [each for each in tables if "__" in each and not each.endswith(f"__{current}")]
    traces_left += [each for each in tables if "pycrorm_progress" in each]
    if at:
        gone = "SELECT nspname FROM pg_namespace WHERE nspname LIKE 'memory\\_gone\\_%' OR nspname = 'memory_new'"
        return traces_left + [name for (name,) in ask(url, gone)]
    file = Path(url.removeprefix("sqlite:///"))
    return traces_left + [each.name for each in file.parent.glob(f"{file.name}-rebuild*")]
