"""Compare the measurements with the budgets of the design; pure functions of the lines that the scripts print."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

__all__ = ["BUDGETS", "Budget", "Verdict", "verdict_on"]

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


def _hook(lines: Lines) -> Verdict:
    configurations = {
        name: each for name, each in lines["hook"].items() if isinstance(each, dict) and "hook_us" in each
    }
    median = max(each["hook_us"] for each in configurations.values())
    p99 = max(each["more_us"]["p99"] / 2 for each in configurations.values())
    worst = max(configurations, key=lambda name: configurations[name]["hook_us"])
    text = (
        f"median {median:g} µs, p99 {p99:g} µs after a pause of 1 ms (maxima over all configurations; median: {worst})"
    )
    if "stages" in lines:
        text += f"; median {lines['stages']['one hook, memory']['median']:g} µs without a pause"
    return Verdict(text, median <= 5 and p99 <= 50)


def _plan(lines: Lines) -> Verdict:
    shares = {writer: lines["plan"][f"with_{writer}"]["slower_by_median"] for writer in ("thread", "daemon")}
    text = ", ".join(f"{writer} {share:+.1%}" for writer, share in shares.items())
    return Verdict(text, all(share <= 0.05 for share in shares.values()))


def _log_against_raw(lines: Lines) -> Verdict:
    shares = {
        database: min(
            figures["ours_is"]["median"]
            for name, figures in lines["others"][database].items()
            if name in ("executemany", "json_each", "COPY")
        )
        for database in ("sqlite", "postgresql")
    }
    text = ", ".join(f"{database} {share:.2f} times" for database, share in shares.items())
    return Verdict(text, all(share >= 0.5 for share in shares.values()))


def _log_against_eventsource(lines: Lines) -> Verdict:
    times = lines["others"]["postgresql"]["eventsource-py"]["ours_is"]["median"]
    return Verdict(f"{times:.1f} times", times >= 10)


def _thesis(database: str, times_min: float) -> Callable[[Lines], Verdict]:
    def read(lines: Lines) -> Verdict:
        sizes = [
            each
            for name, line in lines.items()
            if name.startswith("thesis") and isinstance(line.get(database), list)
            for each in line[database]
        ]
        largest = max(sizes, key=lambda each: each["nodes"])
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
    met = all(each["us_per_event"] <= 1.1 and each["mb"] <= _FLAT_MB for each in growth.values())
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


def _objects_s(lines: Lines) -> Verdict:
    line = lines["objects"]
    seconds = {
        database: [line[database]["actions"][side]["median"] / 1_000 for side in ("ours_ms", "thesis_ms")]
        for database in _OBJECTS_S_MAX
    }
    sides = [
        f"{database} {ours:.2f} s (system of the thesis: {its:.2f} s)" for database, (ours, its) in seconds.items()
    ]
    busy = f"at a load of {line['load_before']} to {line['load_after']}"
    return Verdict(
        f"{', '.join(sides)}, {busy}", all(ours <= _OBJECTS_S_MAX[name] for name, (ours, _) in seconds.items())
    )


_OBJECTS_S_MAX = {"sqlite": 1.0, "postgresql": 0.25}


def _size(lines: Lines) -> Verdict:
    line = lines["size"]
    bytes_a_node = {database: line[database]["ours"]["bytes_a_node"] for database in _SIZES_MAX}
    text = ", ".join(
        f"{database} {each:,} (system of the thesis: {line[database]['thesis_bytes_a_node']})"
        for database, each in bytes_a_node.items()
    )
    return Verdict(text, all(each <= _SIZES_MAX[database] for database, each in bytes_a_node.items()))


_SIZES_MAX = {"sqlite": 800, "postgresql": 1_150}


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
    Budget("one hook, mean of start and end", "median ≤ 5 µs, p99 ≤ 50 µs", _hook),
    Budget("the fastest headless rollout with memory against without", "≤ 5 % slower", _plan),
    Budget("full spool → log against the best raw way of writing the same rows", "≥ 0.5 times", _log_against_raw),
    Budget("full spool → log against eventsource-py, PostgreSQL", "≥ 10 times", _log_against_eventsource),
    Budget(
        "spool → every row in every table against the system of the thesis, SQLite", "≥ 50 times", _thesis("sqlite", 50)
    ),
    Budget("the same, PostgreSQL", "≥ 30 times", _thesis("postgresql", 30)),
    Budget("rebuild", "≥ 100,000 events/s", _rebuild_rate),
    Budget("rebuild, the largest log against the smallest", "≤ 1.1 times per event, flat memory", _rebuild_growth),
    Budget("memory of a recording process", "flat (system of the thesis: 32 kB a node)", _recording),
    Budget("disk a node, log and tables", "≤ 800 bytes SQLite, ≤ 1,150 bytes PostgreSQL", _size),
    Budget("the thesis' learning query over 50,000 pick-ups → DataFrame", "≤ 100 ms", _learning),
    Budget(
        "CPU time of `select(Action)`, 25,000 rows, against the system of the thesis",
        "≤ 1 times",
        _objects_cpu("actions"),
    ),
    Budget("the same, wall time", "≤ 1.0 s SQLite, ≤ 0.25 s PostgreSQL", _objects_s),
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
