"""The plots beside the page, one for each comparison that has more than one point."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.reporting.budgets import Lines

__all__ = ["draw"]

_ORIGINAL = {"sqlite": [(1_000, 1_342), (50_000, 921), (488_044, 987)], "postgresql": [(50_000, 808)]}
"""What the original itself reached, nodes and nodes a second, on another machine of two cores: for orientation."""
_DATABASES = ("sqlite", "postgresql")


def draw(lines: Lines, folder: Path) -> list[str]:
    """Draws what there are figures for; the names of the files. None without matplotlib."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        return []
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "bench"  # so that the same figures are the same file
    from matplotlib import pyplot as plt

    drawn = []
    for name, plot in _PLOTS.items():
        figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
        try:
            for axis, database in zip(axes, _DATABASES, strict=True):
                axis.set_title(database)
                plot(axis, lines, database)
        except (LookupError, TypeError):  # not measured, or not on both
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
    axis.plot(*zip(*_ORIGINAL[database], strict=True), "x", color="grey", label="the original, elsewhere")
    _logarithmic(axis, "nodes", "nodes/s, to every row in every table")


def _others(axis: Any, lines: Lines, database: str) -> None:
    found = {name: each for name, each in lines["others"][database].items() if isinstance(each, dict)}
    rates = [each["events_per_s"]["median"] for each in found.values()]
    axis.barh(list(found), rates, color=["C0" if name == "ours" else "C7" for name in found])
    axis.set_xscale("log")
    axis.set_xlabel("events/s into the log")


def _visible(axis: Any, lines: Lines, database: str) -> None:
    found = lines["visible"][database]
    rates = [int(rate) for rate in found]
    for name in ("median", "p99", "max"):
        axis.plot(rates, [each["ms"][name] for each in found.values()], "o-", label=name)
    _logarithmic(axis, "events/s", "ms from perform to its rows")


def _questions(axis: Any, lines: Lines, database: str) -> None:
    runs = [line[database] for name, line in lines.items() if name.startswith("questions")]
    by_size = dict(sorted((int(size), found) for run in runs for size, found in run.items()))
    for question in ("learning, frame", "learning, kept rows, frame", "all pick-ups with context, frame"):
        _with_spread(axis, list(by_size), [found[question]["ms"] for found in by_size.values()], question)
    _logarithmic(axis, "pick-ups", "ms")


def _growth(axis: Any, lines: Lines, database: str) -> None:
    found = lines["growth"][database]
    for what in ("nodes_in_an_episode", "recorders", "daemons", "episodes"):
        points = {int(value): rate for value, rate in found.get(what, {}).items() if isinstance(rate, dict)}
        if points:
            _with_spread(axis, list(points), list(points.values()), what.replace("_", " "))
    _logarithmic(axis, "so many", "nodes/s, to every row in every table")


def _with_spread(axis: Any, values: list[int], spreads: list[dict[str, float]], name: str) -> None:
    middle = [each["median"] for each in spreads]
    below = [each["median"] - each["least"] for each in spreads]
    above = [each["most"] - each["median"] for each in spreads]
    if not values:
        raise LookupError(name)
    axis.errorbar(values, middle, (below, above), fmt="o-", capsize=3, label=name)


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
