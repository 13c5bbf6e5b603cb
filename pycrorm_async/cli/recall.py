"""List the past actions most like a cue, with their outcomes.

Panel: Ask, 2.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, NamedTuple

import typer

from pycrorm_async.cli.output import Form, moment, note, print_rows, print_table, stdout
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.answer import Answer, Following, RecalledCase
from pycrorm_async.recall.recall import Recall, case_named, check_robot
from pycrorm_async.recall.search import closest

_TERM = re.compile(r"(?P<how>not:|only:)?(?P<feature>[^=~]+)(?P<sign>[=~])(?P<value>.*)", re.DOTALL)
_K = 10
"""The number of actions by default: as many as a terminal shows on one page with the command."""


def recall(
    *,
    cue: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TYPE] [FEATURE=TEXT | FEATURE~NUMBER±TOLERANCE | not:FEATURE=TEXT | only:FEATURE=TEXT]...",
            help="A type of action, and what is sought: object_type=MILK, height~0.93 or height~0.93±0.1 (also +-0.1).",
            show_default=False,
        ),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            metavar="EPISODE/EVENT", help="List actions in a situation like that of the action which this event began."
        ),
    ] = None,
    follows: Annotated[
        bool, typer.Option("--follows", help="Count what came next after the actions of a type, and how that ended.")
    ] = False,
    status: Annotated[str | None, typer.Option(help="With --follows: only after actions of this status.")] = None,
    reason: Annotated[str | None, typer.Option(help="With --follows: only after failures of this class.")] = None,
    k: Annotated[int, typer.Option("--limit", "--k", metavar="N", help="The number of actions.")] = _K,
    before: Annotated[
        str | None, typer.Option(metavar="MOMENT", help="Started before: 2026-11-20, with time, in UTC.")
    ] = None,
    after: Annotated[str | None, typer.Option(metavar="MOMENT", help="Started at this moment or later.")] = None,
    episode: Annotated[
        str | None, typer.Option(help="In this episode: number, id, first digits of the id, or last.")
    ] = None,
    tag: Annotated[str | None, typer.Option(help="In episodes with this tag.")] = None,
    robot: Annotated[str | None, typer.Option(help="Of this robot.")] = None,
    simulated: Annotated[bool, typer.Option("--simulated", help="Also from simulated episodes.")] = False,
    minimum: Annotated[float, typer.Option(help="The lowest score, 0 to 1.")] = 0.0,
    why: Annotated[
        bool, typer.Option("--why", help="Explain each action: what is alike, what differs and by how much.")
    ] = False,
    place: ReadingPlace,
    form: Form,
) -> None:
    """List the past actions most like a cue, with their outcomes."""
    parsed = _parse(cue or [])
    conditions: dict[str, Any] = {
        "before": before, "after": after, "episode": episode, "tag": tag, "robot": robot,
        "simulated": simulated, "k": k, "minimum": minimum,
    }  # fmt: skip
    if (status or reason) and not follows:
        raise CallerError("--status and --reason belong to --follows; to compare them write status=FAILED")
    if follows or like is not None:
        _refuse_conditions(
            conditions, "--follows" if follows else "--like", taken=() if follows else ("simulated", "k")
        )
    if follows:
        _follows(parsed, like, place, form, status=status, reason=reason)
        return
    if like is None and not any(parsed[:-1]):  # `only:` chooses among the cases of a cue
        raise CallerError("name a type or a feature to rank by: `pycrorm recall PickUpAction arm=LEFT`, or add --like")
    if like is not None and cue:
        raise CallerError("--like takes the cue from an action: leave out the type and the features")

    async def query(reading: Reading) -> tuple[Answer, tuple[str, ...], list[tuple[str, int]]]:
        memory = Recall.of(reading)
        if like is not None:
            answer = await memory.like(await case_named(reading, like, "--like"), k=k, simulated=simulated)
        else:
            answer = await memory(
                parsed.type, has=parsed.has, near=parsed.near, lacks=parsed.lacks, only=parsed.only, **conditions
            )
        if robot is not None and ("robot", robot) in answer.never_seen:
            await check_robot(reading, robot)
        return answer, await memory.types(), await answer.outcomes()

    answer, types, outcomes = place.read(query)
    if not form.is_table:  # a table is followed by `answer.why()`, which says the same
        _note_unknown(answer.cue.type, types)
    if form.is_table:
        _print(answer, outcomes, why=why)
    else:
        print_rows(form, _document(answer, outcomes), "", *answer.table())


class _Parsed(NamedTuple):
    """The words of a cue."""

    type: str | None
    has: dict[str, list[str]]
    near: dict[str, tuple[float, ...]]
    lacks: dict[str, list[str]]
    only: dict[str, list[str]]


def _parse(words: list[str]) -> _Parsed:
    """Read the words of a cue. Raises `CallerError`.

    >>> _parse(["PickUpAction", "arm=LEFT", "height~0.93±0.1", "not:near=BOWL"])
    _Parsed(type='PickUpAction', has={'arm': ['LEFT']}, near={'height': (0.93, 0.1)}, lacks={'near': ['BOWL']}, only={})
    """
    parsed = _Parsed(None, {}, {}, {}, {})
    for each in words:
        match = _TERM.fullmatch(each)
        if match is None:
            if parsed.type is not None:
                raise CallerError(f"{each[:60]!r} is not a feature: write FEATURE=TEXT or FEATURE~NUMBER")
            parsed = parsed._replace(type=each)
        elif match["sign"] == "=":
            pairs = {"not:": parsed.lacks, "only:": parsed.only}.get(match["how"] or "", parsed.has)
            pairs.setdefault(match["feature"], []).append(match["value"])
        elif match["how"]:
            raise CallerError(f"{each[:60]!r}: only texts can be excluded or required; write a number as height~0.93")
        elif match["feature"] in parsed.near:
            raise CallerError(f"{match['feature']} is given twice: give one number")
        else:
            parsed.near[match["feature"]] = tuple(
                _number(part, each) for part in re.split(r"±|\+-", match["value"], maxsplit=1)
            )
    return parsed


def _number(text: str, term: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise CallerError(
            f"{term[:60]!r}: {text[:40]!r} is not a number: write FEATURE~NUMBER or FEATURE=TEXT"
        ) from None


def _refuse_conditions(conditions: dict[str, Any], option: str, *, taken: tuple[str, ...]) -> None:
    """Raise `CallerError` for a condition that a search with this option does not have."""
    defaults: dict[str, Any] = {"simulated": False, "k": _K, "minimum": 0.0}
    ignored = [
        f"--{'limit' if name == 'k' else name}"
        for name, each in conditions.items()
        if name not in taken and each != defaults.get(name)
    ]
    if ignored:
        raise CallerError(
            f"{option} does not take {', '.join(ignored)}: leave {'it' if len(ignored) == 1 else 'them'} out"
        )


def _note_unknown(dtype: str | None, types: tuple[str, ...]) -> None:
    if dtype is not None and dtype not in types:
        note(f"no {dtype} has ended in this memory{closest(dtype, types)}")


# --- printing -------------------------------------------------------------------------------------------------


def _print(answer: Answer, outcomes: list[tuple[str, int]], *, why: bool) -> None:
    if why:
        for each in answer:
            stdout.print(each.why(), markup=False, highlight=False)
    elif answer:
        columns = ("score", "status", "reason", "started", "differs", "see")
        rows = [
            (
                each.score,
                each.status,
                each.case.reason,
                moment(each.case.started_at),
                each.difference(),
                f"pycrorm show {each.case.episode} --at e{each.case.sequence}",
            )
            for each in answer
        ]
        print_table(f"Most like {answer.cue}", columns, rows)
    stdout.print(answer.why(), markup=False, highlight=False)
    if outcomes:
        stdout.print(f"  after failures: {', '.join(f'{name} {count}' for name, count in outcomes)}", highlight=False)


def _document(answer: Answer, outcomes: list[tuple[str, int]]) -> dict[str, Any]:
    success = answer.success
    return {
        "cue": str(answer.cue),
        "considered": answer.considered,
        "left_out": answer.cue.left_out,
        "never_seen": [list(each) for each in answer.never_seen],
        "joined": list(answer.joined),
        "notes": list(answer.notes),
        "success": None if success is None else success._asdict(),
        "reasons": dict(answer.reasons),
        "outcomes": dict(outcomes),
        "cases": [_case(each) for each in answer],
    }


def _case(recalled: RecalledCase) -> dict[str, Any]:
    case = recalled.case
    of_case = "status reason duration_s simulated symbols numbers".split()
    return {
        "score": recalled.score,
        "node": case.node,
        "episode": case.episode,
        "sequence": case.sequence,
        "type": case.type,
        "started": case.started_at,
        **{name: getattr(case, name) for name in of_case},
        "matched": [each._asdict() for each in recalled.matched],
        "missed": [each._asdict() for each in recalled.missed],
    }


def _follows(
    parsed: _Parsed, like: str | None, place: ReadingPlace, form: Form, *, status: str | None, reason: str | None
) -> None:
    dtype = parsed.type
    if dtype is None or like is not None or any(parsed[1:]):
        raise CallerError("--follows takes one type, as in `pycrorm recall --follows PickUpAction --reason IKError`")

    async def query(reading: Reading) -> tuple[Following, tuple[str, ...], tuple[str, ...]]:
        memory = Recall.of(reading)
        following = await memory.follows(dtype, status=status, reason=reason)
        return following, await memory.types(), await memory.reasons(dtype)

    following, types, reasons = place.read(query)
    _note_unknown(dtype, types)
    if reason is not None and dtype in types and reason not in reasons:
        note(f"no {dtype} has ended with the reason {reason}{closest(reason, reasons)}")
    followers = [each._asdict() | {"success": each.success and each.success._asdict()} for each in following.followers]
    document = {"cases": following.cases, "followers": followers}
    rows = [
        (each.type or "(nothing)", each.cases, f"{100 * each.share:.0f} %", str(each.success) if each.success else "")
        for each in following.followers
    ]
    after = " ".join([dtype, *([status] if status else []), *([f"({reason})"] if reason else [])])
    print_rows(form, document, f"After {following.cases:,} {after}", ("next", "times", "share", "success"), rows)
