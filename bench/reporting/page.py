"""Write the Markdown page of all figures, and draw its plots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.reporting.budgets import BUDGETS, Lines, verdict_on

# === page =====================================================================================================
#
# Write the Markdown page of all figures: the budgets with their verdicts, then every figure of every run.

_SPREADS = ({"median", "least", "most"}, {"median", "p99", "p99.9", "max"})
_ABOUT = ("bench", "command", "took_s", "versions", "hardware", "load_before", "load_after")
_MET = {True: "yes", False: "**no**", None: ""}


def page(lines: Lines, plots: list[str]) -> str:
    """Return the whole page, with the runs in the order of `lines`."""
    parts = ["# Figures", *_about(lines), "## Budgets", _budgets(lines)]
    parts += [f"![{plot.removesuffix('.svg')}]({plot})" for plot in plots]
    for name, line in lines.items():
        busy = f"load {line['load_before']} to {line['load_after']} on {line['hardware']['cores']} cores"
        parts += [f"## {name}", f"`{line['command']}`, {line['took_s']:g} s, {busy}", _figures(line)]
    return "\n\n".join(parts) + "\n"


def _about(lines: Lines) -> Iterator[str]:
    for line in list(lines.values())[:1]:
        machine = line["hardware"]
        yield f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB, Linux {machine['kernel']}."
        yield ", ".join(f"{name} {each}" for name, each in line["versions"].items()) + "."


def _budgets(lines: Lines) -> str:
    rows = ["| measurement | budget | measured | met |", "|---|---|---|---|"]
    for budget in BUDGETS:
        verdict = verdict_on(budget, lines)
        rows.append(f"| {budget.measurement} | {budget.budget} | {verdict.measured} | {_MET[verdict.met]} |")
    return "\n".join(rows)


def _figures(line: Mapping[str, Any]) -> str:
    rows = ["| | |", "|---|---|"]
    figures = {name: value for name, value in line.items() if name not in _ABOUT}
    rows += [f"| {path} | {value} |" for path, value in rows_of(figures)]
    return "\n".join(rows)


def rows_of(figures: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield every figure with its path. A spread, such as median, least and most, is one figure."""
    match figures:
        case dict() if set(figures) in _SPREADS:
            others = ", ".join(f"{name} {_written(each)}" for name, each in list(figures.items())[1:])
            yield path, f"{_written(figures['median'])} ({others})"
        case dict():
            for name, each in figures.items():
                yield from rows_of(each, f"{path}, {name}" if path else str(name))
        case list() if any(isinstance(each, dict) for each in figures):
            for each in figures:
                yield from rows_of(each, f"{path}, {each.get('nodes', each.get('events', ''))}")
        case _:
            yield path, _written(figures)


def _written(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_written, value))
    return f"{value:,}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


# === plots ====================================================================================================
#
# Draw the plots of the page, one for each comparison with several points.

_ORIGINAL = {"sqlite": [(1_000, 1_342), (50_000, 921), (488_044, 987)], "postgresql": [(50_000, 808)]}
"""Nodes, and nodes a second, that the thesis' own system reached on another machine with two cores."""
_DATABASES = ("sqlite", "postgresql")


def draw(lines: Lines, folder: Path) -> list[str]:
    """Draw every plot that has figures, and return the file names. Without matplotlib nothing is drawn."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        return []
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "bench"  # without it ids are random, and the same figures give another file
    from matplotlib import pyplot as plt

    drawn = []
    for name, plot in _PLOTS.items():
        figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
        try:
            for axis, database in zip(axes, _DATABASES, strict=True):
                axis.set_title(database)
                plot(axis, lines, database)
        except (LookupError, TypeError):  # not measured, or on one database only
            continue
        finally:
            plt.close(figure)
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        drawn.append(f"{name}.svg")
    return drawn


def _thesis(axis: Any, lines: Lines, database: str) -> None:
    runs = [line[database] for name, line in lines.items() if name.startswith("thesis") and database in line]
    sizes = sorted((each for run in runs for each in run), key=lambda each: each["nodes"])
    nodes = [each["nodes"] for each in sizes]
    for side, name in (("ours", "ours"), ("baseline", "the system of the thesis")):
        rates = [each[f"{side}_nodes_per_s"] for each in sizes]
        _with_spread(axis, nodes, rates, name)
    axis.plot(*zip(*_ORIGINAL[database], strict=True), "x", color="grey", label="the thesis' system, another machine")
    _logarithmic(axis, "nodes", "nodes/s, to every row in every table")


def _others(axis: Any, lines: Lines, database: str) -> None:
    contenders = {name: each for name, each in lines["others"][database].items() if isinstance(each, dict)}
    rates = [each["events_per_s"]["median"] for each in contenders.values()]
    axis.barh(list(contenders), rates, color=["C0" if name == "ours" else "C7" for name in contenders])
    axis.set_xscale("log")
    axis.set_xlabel("events/s into the log")


def _visible(axis: Any, lines: Lines, database: str) -> None:
    by_rate = lines["visible"][database]
    rates = [int(rate) for rate in by_rate]
    for name in ("median", "p99", "max"):
        axis.plot(rates, [each["ms"][name] for each in by_rate.values()], "o-", label=name)
    _logarithmic(axis, "events/s", "ms from perform to its rows")


def _questions(axis: Any, lines: Lines, database: str) -> None:
    runs = [line[database] for name, line in lines.items() if name.startswith("questions")]
    by_size = dict(sorted((int(size), by_question) for run in runs for size, by_question in run.items()))
    for question in ("learning, frame", "learning, kept rows, frame", "all pick-ups with context, frame"):
        _with_spread(axis, list(by_size), [by_question[question]["ms"] for by_question in by_size.values()], question)
    _logarithmic(axis, "pick-ups", "ms")


def _growth(axis: Any, lines: Lines, database: str) -> None:
    curves = lines["growth"][database]
    for parameter in ("nodes_in_an_episode", "recorders", "daemons", "episodes"):
        points = {int(value): rate for value, rate in curves.get(parameter, {}).items() if isinstance(rate, dict)}
        if points:
            _with_spread(axis, list(points), list(points.values()), parameter.replace("_", " "))
    _logarithmic(axis, "number", "nodes/s, to every row in every table")


def _with_spread(axis: Any, values: list[int], spreads: list[dict[str, float]], name: str) -> None:
    medians = [each["median"] for each in spreads]
    below = [each["median"] - each["least"] for each in spreads]
    above = [each["most"] - each["median"] for each in spreads]
    if not values:
        raise LookupError(name)
    axis.errorbar(values, medians, (below, above), fmt="o-", capsize=3, label=name)


def _logarithmic(axis: Any, x: str, y: str) -> None:
    axis.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axis.legend(fontsize="small")


_PLOTS: dict[str, Callable[[Any, Lines, str], None]] = {
    "thesis": _thesis,
    "others": _others,
    "visible": _visible,
    "questions": _questions,
    "growth": _growth,
}
