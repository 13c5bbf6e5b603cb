"""Write the tables and the plot that the READMEs show, from the lines that the scripts printed."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from bench.reporting.budgets import BUDGETS, DATABASES, Lines, Verdict, each_of, measured, verdict_on
from bench.reporting.figures import MISSING

README: Final = Path("bench/README.md")
_MET = {True: "yes", False: "**no**", None: ""}
_WRITERS = ("thread", "process", "daemon")
_BLOCK: Final = re.compile(r"(<!-- bench: (\w+) -->\n).*?(\n<!-- end -->)", re.DOTALL)


def table_of(columns: list[str], rows: list[list[str]], *, numbers: int = 0) -> str:
    """Return a Markdown table; the last `numbers` columns are aligned to the right."""
    rule = ["---"] * (len(columns) - numbers) + ["---:"] * numbers
    return "\n".join(f"| {' | '.join(each)} |" for each in (columns, rule, *rows))


# === what a user asks =========================================================================================


def _action(lines: Lines) -> str:
    way = lines["rivals"]["ways"]["this package, a plan of ours"]
    warm, cold = way["warm_us"], way["cold_us"]
    return (
        f"{warm:.0f} µs of the plan's thread, {way['times_warm']:.2f} times two JSON lines with a flush; after a pause"
        f" {cold:.0f} µs, {way['times_cold']:.2f} times"
    )


def _rollout(lines: Lines) -> str:
    line = lines["plan"]
    shares = ", ".join(f"{writer} {line[f'with_{writer}']['slower_by_median']:+.0%}" for writer in _WRITERS)
    more_us = line["with_process"]["us_a_rollout"]
    return f"{shares}; of a rollout of 97 ms, as those of the thesis, {more_us / 97_000:.1%} (process)"


def _killed(lines: Lines) -> str:
    ways = [each for name, each in lines["rivals"]["ways"].items() if name.startswith("this package")]
    lost, reported = (sum(each[name] for each in ways) for name in ("lost", "reported"))
    return f"{lost} of {reported:,} events whose call had returned"


def _behind(lines: Lines) -> str:
    ms = {database: lines["visible"][database]["1000"]["ms"] for database in DATABASES}
    return each_of(ms, lambda each: f"{each['median']:.0f} ms (p99 {each['p99']:.0f} ms)")


def _backlog(lines: Lines) -> str:
    busy = {"sqlite": lines["busy"], "postgresql": lines["busy postgresql"]}
    return each_of(busy, lambda each: f"at most {each['backlog_max']:,} of {each['events']:,} events not stored")


def _full_spool(lines: Lines) -> str:
    rates = {"sqlite": lines["daemon"]["from_1"], "postgresql": lines["daemon postgresql"]["from_1"]}
    return each_of(rates, lambda each: f"{each['shown_per_s']:,} events/s")


def _large(lines: Lines) -> str:
    return each_of(lines["size"], lambda each: f"{each['ours']['bytes_a_node']:,} bytes a node")


def _import(lines: Lines) -> str:
    line = lines["start"]
    return f"{line['cpu_ms']['import Memory']:.0f} ms of CPU time and {line['memory_mb']['import Memory']} MB"


def _asked(lines: Lines) -> str:
    asked = {name: lines["questions"][name]["50000"]["learning, frame"] for name in DATABASES}
    return each_of(asked, lambda each: f"{each['ms']['median']:.0f} ms")


def _thesis(lines: Lines) -> str:
    sizes = {name: max(measured(lines, name), key=lambda each: each["nodes"]) for name in DATABASES}
    return each_of(sizes, lambda each: f"{each['times_faster']['median']:.0f} times, at {each['nodes']:,} nodes")


ANSWERS: Final[dict[str, Callable[[Lines], str]]] = {
    "What does an action cost my plan, its start and its end?": _action,
    "How much slower is the fastest headless rollout (0.3 ms, 29 events)?": _rollout,
    "What does a process lose that is killed with SIGKILL?": _killed,
    "How far behind are the tables at 1,000 events/s (process, daemon)?": _behind,
    "How far behind is the log beside a plan that never pauses (thread, 2,000 events/s)?": _backlog,
    "How fast is a full spool drained into the tables?": _full_spool,
    "How large does it get, log and tables?": _large,
    "What does importing it cost?": _import,
    "How long does the learning query over 50,000 pick-ups take, as a data frame?": _asked,
    "How much faster is it than the thesis' system, to every row in every table?": _thesis,
}


def answers(lines: Lines) -> str:
    rows = []
    for question, read in ANSWERS.items():
        try:
            answer = read(_whole(lines))
        except (LookupError, TypeError, ValueError):
            answer = "not measured"
        rows.append([question, answer])
    return table_of(["question", "answer"], rows)


# === tables ===================================================================================================


def budgets(lines: Lines) -> str:
    verdicts: list[Verdict] = [verdict_on(each, lines) for each in BUDGETS]
    rows = [
        [budget.measurement, budget.budget, verdict.measured, _MET[verdict.met]]
        for budget, verdict in zip(BUDGETS, verdicts, strict=True)
    ]
    return table_of(["measurement", "budget", "measured", "met"], rows)


def rivals(lines: Lines) -> str:
    rows = []
    for name, each in _whole(lines).get("rivals", {}).get("ways", {}).items():
        if each == MISSING:
            rows.append([name, MISSING, "", "", "", "", ""])
            continue
        costs = [f"{each[part]:,.{digits}f}" for part, digits in _COSTS.items()]
        rows.append([name, each["answers"], *costs, f"{each['reported'] - each['lost']} of {each['reported']}"])
    columns = ["way", "answers questions", "µs, warm", "times", "µs, cold", "times", "left after SIGKILL"]
    return table_of(columns, rows, numbers=5) if rows else "Not measured."


_COSTS = {"warm_us": 1, "times_warm": 2, "cold_us": 1, "times_cold": 2}


def into_the_log(lines: Lines) -> str:
    line = _whole(lines).get("others", {})
    names = {name: None for database in DATABASES for name in line.get(database, {}) if name != "events"}
    rows = [
        [_WAYS.get(name, f"`{name}`"), *(_rate(line[database].get(name)) for database in DATABASES)] for name in names
    ]
    return table_of(["into the log, events/s", "SQLite", "PostgreSQL"], rows, numbers=2) if rows else "Not measured."


_WAYS = {
    "ours": "full spool, read, checked, stored",
    "executemany": "the same rows without a spool, `executemany`",
    "json_each": "… `json_each`",
    "COPY": "… COPY",
}


def _rate(figures: Any) -> str:
    return f"{figures['events_per_s']['median']:,}" if isinstance(figures, dict) else ""


def _whole(lines: Lines) -> Lines:
    """Leave out the lines of quick runs, which are too short."""
    return {name: each for name, each in lines.items() if "--quick" not in each["command"]}


def machine(lines: Lines) -> str:
    """Return a sentence about the machine of each set of lines."""
    described = dict.fromkeys(
        f"{each['hardware']['processor']}, {each['hardware']['cores']} cores, {each['hardware']['memory_gb']} GB,"
        f" Linux {each['hardware']['kernel']}, Python {each['versions']['python']}"
        for each in lines.values()
    )
    loads = [each["load_before"] for each in lines.values()]
    busy = f"load before each run {min(loads):g} to {max(loads):g}" if loads else "no run"
    return f"{'; '.join(described)}; {busy}."


TABLES: Final[dict[str, Callable[[Lines], str]]] = {
    "answers": answers, "machine": machine, "rivals": rivals, "budgets": budgets, "into_the_log": into_the_log,
}  # fmt: skip


def written(page: str, lines: Lines) -> str:
    """Return the page with each block `<!-- bench: NAME --> … <!-- end -->` replaced by its table."""
    return _BLOCK.sub(lambda found: f"{found[1]}\n{TABLES[found[2]](lines)}\n{found[3]}", page)


# === plot =====================================================================================================

_ORIGINAL = {"sqlite": [(1_000, 1_342), (50_000, 921), (488_044, 987)], "postgresql": [(50_000, 808)]}
"""Nodes, and nodes a second, that the thesis' own system reached on another machine with two cores."""


def draw(lines: Lines, folder: Path) -> None:
    """Draw the rates of this package and of the thesis' system as `thesis.svg`, if both databases were measured.

    Raises `ModuleNotFoundError` without matplotlib.
    """
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "bench"  # without it ids are random, and the same figures give another file
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, database in zip(axes, DATABASES, strict=True):
        sizes = sorted(measured(lines, database), key=lambda each: each["nodes"])
        for side, name in (("ours", "ours"), ("baseline", "the system of the thesis")):
            spreads = [each[f"{side}_nodes_per_s"] for each in sizes]
            medians = [each["median"] for each in spreads]
            off = [
                [each["median"] - each["least"] for each in spreads],
                [each["most"] - each["median"] for each in spreads],
            ]
            axis.errorbar([each["nodes"] for each in sizes], medians, off, fmt="o-", capsize=3, label=name)
        axis.plot(
            *zip(*_ORIGINAL[database], strict=True), "x", color="grey", label="the thesis' system, another machine"
        )
        axis.set(
            title=database, xscale="log", yscale="log", xlabel="nodes", ylabel="nodes/s, to every row in every table"
        )
        axis.legend(fontsize="small")
    if all(measured(lines, database) for database in DATABASES):
        figure.savefig(folder / "thesis.svg", metadata={"Date": None})
    plt.close(figure)
