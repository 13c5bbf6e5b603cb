"""Write the Markdown page of all figures: the budgets with their verdicts, then every figure of every run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bench.reporting.budgets import BUDGETS, Lines, verdict_on

__all__ = ["page", "rows_of"]

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
