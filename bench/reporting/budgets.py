"""Compare the measurements with the budgets of the design; pure functions of the lines that the scripts print."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, TypeVar

__all__ = ["BUDGETS", "DATABASES", "Budget", "Lines", "Verdict", "each_of", "measured", "verdict_on"]

DATABASES: Final = ("sqlite", "postgresql")
Lines = Mapping[str, Mapping[str, Any]]
"""The line that each run printed, by the name of the run."""


class Verdict(NamedTuple):
    """A measured value as text; `met` is True if the budget is met, and None if nothing was measured."""

    measured: str
    met: bool | None


class Budget(NamedTuple):
    """A limit for one measurement; `read` derives the verdict and raises `LookupError` if the script did not run."""

    measurement: str
    budget: str
    read: Callable[[Lines], Verdict]


def verdict_on(budget: Budget, lines: Lines) -> Verdict:
    """Return the verdict on one budget. Lines of quick runs are ignored, because their measurements are too short."""
    measured = {name: line for name, line in lines.items() if "--quick" not in line["command"]}
    try:
        return budget.read(measured)
    except (LookupError, TypeError, ValueError):  # not run, or printed by an older script
        return Verdict("not measured", None)


_T = TypeVar("_T")


def each_of(by_database: Mapping[str, _T], text: Callable[[_T], str]) -> str:
    """Return a text about both databases."""
    return ", ".join(f"{name} {text(by_database[database])}" for database, name in _NAMES.items())


_NAMES: Final = {"sqlite": "SQLite", "postgresql": "PostgreSQL"}


def measured(lines: Lines, database: str) -> list[dict[str, Any]]:
    """Return the figures of every size at which `bench.thesis` compared with the thesis' system."""
    runs = [line[database] for name, line in lines.items() if name.startswith("thesis") and database in line]
    return [size for run in runs for size in run]


def _limits(by_database: Mapping[str, float], text: Callable[[float], str], most: Mapping[str, float]) -> Verdict:
    return Verdict(each_of(by_database, text), all(by_database[name] <= most[name] for name in most))


_ACTION = {"compiled": 1.0, "pure": 1.8}


def _action(lines: Lines) -> Verdict:
    way, core = lines["rivals"]["ways"]["this package, a plan of ours"], lines["rivals"]["core"]
    text = f"{way['times_warm']:.2f} times warm, {way['times_cold']:.2f} cold ({core} core)"
    return Verdict(text, way["times_warm"] <= _ACTION[core] and way["times_cold"] <= _ACTION[core])


def _action_mcap(lines: Lines) -> Verdict:
    ways = lines["rivals"]["ways"]
    times = [ways["this package, a plan of ours"][part] / ways["MCAP, flush"][part] for part in ("warm_us", "cold_us")]
    return Verdict(f"{times[0]:.2f} times warm, {times[1]:.2f} cold", max(times) < 1)


_PLAN = {"thread": 0.75, "process": 0.55, "daemon": 0.55}


def _plan(lines: Lines) -> Verdict:
    shares = {writer: lines["plan"][f"with_{writer}"]["slower_by_median"] for writer in _PLAN}
    text = ", ".join(f"{writer} {share:+.1%}" for writer, share in shares.items())
    return Verdict(text, all(share <= _PLAN[writer] for writer, share in shares.items()))


def _long_rollout(lines: Lines) -> Verdict:
    shares = {writer: lines["plan"][f"with_{writer}"]["us_a_rollout"] / 97_000 for writer in _PLAN}
    text = ", ".join(f"{writer} {share:.2%}" for writer, share in shares.items())
    return Verdict(text, max(shares.values()) <= 0.002)


def _hook_to_row(lines: Lines) -> Verdict:
    times = lines["gate"]["ratios"]["hook to row"]
    return Verdict(f"{times:.2f} times", times <= 1.5)


def _start(lines: Lines) -> Verdict:
    times = lines["start"]["times"]
    text = ", ".join(f"{name} {each:.2f} times" for name, each in times.items())
    most = {"import Memory": 1.3, "pycrorm episodes": 1.5, "pycrorm --version": 2.0}
    return Verdict(text, all(times[name] <= most[name] for name in most))


def _log_against_raw(lines: Lines) -> Verdict:
    shares = {
        database: min(
            figures["ours_is"]["median"]
            for name, figures in lines["others"][database].items()
            if name in ("executemany", "json_each", "COPY")
        )
        for database in ("sqlite", "postgresql")
    }
    met = shares["sqlite"] >= 0.55 and shares["postgresql"] >= 0.5
    return Verdict(each_of(shares, lambda share: f"{share:.2f} times"), met)


def _log_against_eventsource(lines: Lines) -> Verdict:
    times = lines["others"]["postgresql"]["eventsource-py"]["ours_is"]["median"]
    return Verdict(f"{times:.1f} times", times >= 10)


def _thesis(database: str, times_min: float) -> Callable[[Lines], Verdict]:
    def read(lines: Lines) -> Verdict:
        largest = max(measured(lines, database), key=lambda each: each["nodes"])
        times = largest["times_faster"]["median"]
        return Verdict(f"{times:.1f} times at {largest['nodes']:,} nodes", times >= times_min)

    return read


def _rebuild_rate(lines: Lines) -> Verdict:
    rates = {database: _rebuilt(lines, database)[-1]["events_per_s"] for database in ("sqlite", "postgresql")}
    by_two = {database: _rebuilt(lines, database, workers="2")[-1]["events_per_s"] for database in rates}
    text = ", ".join(
        f"{database} {by_two[database]:,} events/s ({rate:,} with one)" for database, rate in rates.items()
    )
    return Verdict(
        f"with two processes, which `pycrorm rebuild` uses on an idle machine: {text}",
        all(rate >= 100_000 for rate in by_two.values()),
    )


def _rebuild_growth(lines: Lines) -> Verdict:
    largest = {
        database: max(
            (each for name, each in lines.items() if name.startswith("rebuild") and each["database"] == database),
            key=lambda line: line["by_workers"]["1"][-1]["events"],
        )
        for database in ("sqlite", "postgresql")
    }
    growth = {database: line["growth"]["1"] for database, line in largest.items()}
    met = all(each["us_per_event"] <= 1.2 and each["mb"] <= _FLAT_MB for each in growth.values())
    return Verdict(", ".join(_grown(database, line) for database, line in largest.items()), met)


def _grown(database: str, line: Mapping[str, Any]) -> str:
    grown, sizes = line["growth"]["1"], [each["events"] for each in line["by_workers"]["1"]]
    times = f"{database} {grown['us_per_event']:.2f} times, {grown['mb']:+g} MB"
    return f"{times} ({sizes[0]:,} to {sizes[-1]:,} events)"


_FLAT_MB = 16


def _rebuilt(lines: Lines, database: str, *, workers: str = "1") -> list[dict[str, Any]]:
    return list(lines["rebuild" if database == "sqlite" else "rebuild postgresql"]["by_workers"][workers])


def _recording(lines: Lines) -> Verdict:
    bytes_a_node = {
        database: lines["growth"][database]["recording"]["bytes_a_node"] for database in ("sqlite", "postgresql")
    }
    text = ", ".join(f"{database} {each:g} bytes a node" for database, each in bytes_a_node.items())
    return Verdict(text, all(each < _FLAT_BYTES for each in bytes_a_node.values()))


_FLAT_BYTES = 100


def _learning(lines: Lines) -> Verdict:
    median_ms = {
        database: lines["questions"][database]["50000"]["learning, frame"]["ms"]["median"]
        for database in ("sqlite", "postgresql")
    }
    text = ", ".join(f"{database} {each:.0f} ms" for database, each in median_ms.items())
    return Verdict(text, all(each <= 100 for each in median_ms.values()))


def _objects_cpu(query: str) -> Callable[[Lines], Verdict]:
    def read(lines: Lines) -> Verdict:
        line = lines["objects"]
        times = {database: line[database][query]["ours_is"]["median"] for database in ("sqlite", "postgresql")}
        text = ", ".join(f"{database} {each:.2f} times" for database, each in times.items())
        return Verdict(text, all(each <= 1 for each in times.values()))

    return read


def _size(lines: Lines) -> Verdict:
    bytes_a_node = {database: lines["size"][database]["ours"]["bytes_a_node"] for database in DATABASES}
    return _limits(bytes_a_node, lambda each: f"{each:,}", {"sqlite": 700, "postgresql": 1_000})


def _size_learned(lines: Lines) -> Verdict:
    learned = {database: lines["size"][database].get("learned") for database in DATABASES}
    bytes_a_node = {name: each["bytes_a_node"] for name, each in learned.items() if isinstance(each, Mapping)}
    if len(bytes_a_node) < len(learned):
        return Verdict("not measured: install the extra 'learning'", None)
    return _limits(bytes_a_node, lambda each: f"{each:,}", {"sqlite": 1_000, "postgresql": 1_400})


def _recall_common(lines: Lines) -> Verdict:
    line = _recalled(lines)
    common, soar = line["recall_ms"]["common"]["median"], line["soar"]
    beside = soar["recall_ms"]["common"]["median"] if isinstance(soar, dict) else None
    text = f"{common:g} ms" if beside is None else f"{common:g} ms, Soar {beside:g} ms"
    return Verdict(text, common <= 0.2 and (beside is None or common <= beside))


def _recall_kinds(lines: Lines) -> Verdict:
    line = _recalled(lines)
    slowest = max(line["recall_ms"], key=lambda kind: line["recall_ms"][kind]["p99"])
    p99, size = line["recall_ms"][slowest]["p99"], line["bytes_an_action"]
    return Verdict(f"{p99:g} ms ({slowest}), {size:g} bytes an action", p99 <= 10 and size <= 80)


def _recall_growth(lines: Lines) -> Verdict:
    smaller, larger = _recalled(lines), lines["recall, large"]["10,000,000"]
    times = {
        kind: each["median"] / smaller["recall_ms"][kind]["median"] / 10 for kind, each in larger["recall_ms"].items()
    }
    worst = max(times, key=lambda kind: times[kind])
    text = f"{times[worst]:.2f} times an action ({worst})"
    return Verdict(f"{text}, {larger['bytes_an_action']:g} bytes an action", times[worst] <= 1.1)


def _cases_fold(lines: Lines) -> Verdict:
    return _of_cases(lines, "fold_cpu_us_an_action", "µs", {"sqlite": 25, "postgresql": 25})


def _cases_load(lines: Lines) -> Verdict:
    return _of_cases(lines, "load_ms", "ms", {"sqlite": 100, "postgresql": 200})


def _of_cases(lines: Lines, figure: str, unit: str, most: Mapping[str, float]) -> Verdict:
    medians = {database: lines["cases"][database][figure]["median"] for database in most}
    text = ", ".join(f"{database} {each:g} {unit}" for database, each in medians.items())
    return Verdict(text, all(each <= most[database] for database, each in medians.items()))


def _recalled(lines: Lines) -> Mapping[str, Any]:
    largest: Mapping[str, Any] = lines["recall"]["1,000,000"]
    return largest


BUDGETS = (
    Budget("an action (start, end) against two JSON lines with flush", "≤ 1.0 times compiled, ≤ 1.8 pure", _action),
    Budget("an action against MCAP with flush", "< 1 times", _action_mcap),
    Budget("the fastest headless rollout with memory", "≤ +55 % process or daemon, ≤ +75 % thread", _plan),
    Budget("a rollout of 97 ms, as those of the thesis", "≤ 0.2 %", _long_rollout),
    Budget("hook to row, CPU time, against the same rows raw", "≤ 1.5 times", _hook_to_row),
    Budget(
        "full spool → log against the best raw way of writing the same rows",
        "≥ 0.55 times SQLite, ≥ 0.5 PostgreSQL",
        _log_against_raw,
    ),
    Budget("full spool → log against eventsource-py, PostgreSQL", "≥ 10 times", _log_against_eventsource),
    Budget(
        "spool → every row in every table against the system of the thesis, SQLite", "≥ 90 times", _thesis("sqlite", 90)
    ),
    Budget("the same, PostgreSQL", "≥ 60 times", _thesis("postgresql", 60)),
    Budget("rebuild", "≥ 100,000 events/s", _rebuild_rate),
    Budget("rebuild, the largest log against the smallest", "≤ 1.2 times per event, flat memory", _rebuild_growth),
    Budget("memory of a recording process", "flat (system of the thesis: 32 kB a node)", _recording),
    Budget(
        "CPU time of a start against the libraries that it needs",
        "≤ 1.3 times `Memory`, ≤ 1.5 a verb, ≤ 2 `--version`",
        _start,
    ),
    Budget("disk a node, log and tables", "≤ 700 bytes SQLite, ≤ 1,000 bytes PostgreSQL", _size),
    Budget("the same of `pycrorm learn`", "≤ 1,000 bytes SQLite, ≤ 1,400 bytes PostgreSQL", _size_learned),
    Budget("the thesis' learning query over 50,000 pick-ups → DataFrame", "≤ 100 ms", _learning),
    Budget(
        "CPU time of `select(Action)`, 25,000 rows, against the system of the thesis",
        "≤ 1 times",
        _objects_cpu("actions"),
    ),
    Budget(
        "CPU time of `select(PickUpAction)`, 6,249 rows, against the system of the thesis",
        "≤ 1 times",
        _objects_cpu("pick-ups"),
    ),
    Budget("recall of a common cue among 1,000,000 actions, beside Soar", "median ≤ 0.2 ms, ≤ Soar's", _recall_common),
    Budget("recall by every kind of cue among 1,000,000 actions", "p99 ≤ 10 ms, ≤ 80 bytes an action", _recall_kinds),
    Budget("recall among 10,000,000 actions against 1,000,000", "≤ 1.1 times an action", _recall_growth),
    Budget("making the case of an action, CPU time", "≤ 25 µs", _cases_fold),
    Budget("loading the cases of 1,000,000 actions", "≤ 100 ms SQLite, ≤ 200 ms PostgreSQL", _cases_load),
)
