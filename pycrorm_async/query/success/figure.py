"""Draw successes over two columns by matplotlib: the rates of cells as a heat map, or each row as a point."""

from __future__ import annotations

import io
import math
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.query.success.interval import interval_95
from pycrorm_async.query.success.samples import Samples, Values
from pycrorm_async.query.success.success_table import Axis, Cell, SuccessTable, success_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Kind: TypeAlias = Literal["auto", "heatmap", "scatter"]

_POINTS_MAX = 500
"""Up to this many rows, `auto` draws two numeric columns as points."""
_FEW = 5
"""A cell of fewer rows is hatched, because its rate is uncertain."""
_CELLS_WITH_INTERVAL, _CELLS_WITH_COUNT, _CELLS_WITH_RATE = 40, 300, 600
"""Bounds the cells of a figure whose labels have the interval, the count and the rate: more would overlap."""
_TICKS_MAX = 14
"""Bounds the labels along an axis; times are wider, so half as many fit."""
_BLUE, _ORANGE = "#0072b2", "#d55e00"


def success_figure(
    samples: Samples, *, kind: Kind = "auto", bins: int | None = None, axes: Axes | None = None
) -> Figure:
    """Return a figure of the samples, or draw them into `axes` and return its figure.

    Raises `MissingExtra` without matplotlib; `CallerError` for another kind or number of bins.
    """
    if kind not in get_args(Kind):
        raise CallerError(f"kind must be 'auto', 'heatmap' or 'scatter', got {kind!r}")
    table = success_table(samples, bins=bins)
    figure_type = _figure_type()
    if axes is None:
        figure = figure_type(figsize=(8.4, 6.4), layout="constrained")
        axes = figure.add_subplot()
    numeric = not samples.x.categories and not samples.y.categories
    if kind == "scatter" or (kind == "auto" and numeric and table.rows <= _POINTS_MAX):
        _draw_points(axes, samples)
    else:
        _draw_cells(axes, table)
    axes.set_xlabel(_label(samples.x))
    axes.set_ylabel(_label(samples.y))
    axes.set_title(_title(table), fontsize=10, loc="left")
    drawn: Figure = axes.get_figure(root=True)  # type: ignore[assignment]
    return drawn


@cache
def _figure_type() -> type[Figure]:
    """Return the class of a figure that a notebook draws without pyplot."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("a picture of successes needs matplotlib: pip install 'pycrorm-async[pictures]'") from None

    class NotebookFigure(Figure):
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            FigureCanvasAgg(self)

        def _repr_png_(self) -> bytes:
            buffer = io.BytesIO()
            self.savefig(buffer, format="png", dpi=80)
            return buffer.getvalue()

    return NotebookFigure


def _label(values: Values) -> str:
    """Return the name of a column with its unit; times are shown in UTC."""
    unit = "UTC" if values.is_time else values.unit
    return _plain(f"{values.name}, {unit}" if unit else values.name)


def _title(table: SuccessTable) -> str:
    low, high = interval_95(table.succeeded, table.rows)
    rate = f"{_percent(table.succeeded / table.rows)} of {table.rows:,} succeeded (95 %: {_percent(low, high)})"
    left_out = [f"{table.missing:,} without a value"] if table.missing else []
    left_out += [f"{table.running:,} not ended"] if table.running else []
    more = f"; left out: {', '.join(left_out)}" if left_out else ""
    return _plain(f"{table.source}: success over {table.x.name} and {table.y.name}\n{rate}{more}")


def _percent(*rates: float) -> str:
    return f"{' to '.join(f'{100 * each:.3g}' for each in rates)} %"


def _draw_cells(axes: Axes, table: SuccessTable) -> None:
    rates = np.full((table.y.cells, table.x.cells), np.nan)
    for cell in table.cells:
        rates[cell.y, cell.x] = cell.rate
    mesh = axes.pcolormesh(rates, cmap="viridis", vmin=0, vmax=1, edgecolors="white", linewidth=0.5)
    figure = axes.get_figure(root=True)
    assert figure is not None, "axes belong to a figure"
    figure.colorbar(mesh, ax=axes, shrink=0.8, label="share of successes; hatched: fewer than 5 rows")
    cells_drawn = table.x.cells * table.y.cells
    for cell in table.cells:
        dark = cell.rate < 0.6
        if cell.rows < _FEW:
            axes.add_patch(_hatched(cell, "white" if dark else "black"))
        if text := _text(cell, cells_drawn):
            color = "white" if dark else "black"
            size = 9 if cells_drawn <= _CELLS_WITH_INTERVAL else 7 if cells_drawn <= _CELLS_WITH_COUNT / 2 else 5.5
            axes.text(cell.x + 0.5, cell.y + 0.5, text, ha="center", va="center", color=color, fontsize=size)
    _ticks(axes.xaxis, table.x)
    _ticks(axes.yaxis, table.y)
    if table.x.edges and table.y.edges and math.isclose(table.x.step, table.y.step):
        axes.set_aspect("equal")
    if table.x.labels and max(map(len, table.x.labels)) * table.x.cells > 70:
        axes.tick_params(axis="x", rotation=45)


def _hatched(cell: Cell, color: str) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((cell.x, cell.y), 1, 1, fill=False, hatch="///", edgecolor=color, linewidth=0, alpha=0.3)


def _text(cell: Cell, cells_drawn: int) -> str:
    rate = f"{100 * cell.rate:.0f} %"
    if cells_drawn <= _CELLS_WITH_INTERVAL:
        low, high = cell.interval
        return f"{rate}\n{100 * low:.0f} to {100 * high:.0f} %\nn = {cell.rows:,}"
    if cells_drawn <= _CELLS_WITH_COUNT:
        return f"{rate}\n{cell.rows:,}"
    return f"{100 * cell.rate:.0f}" if cells_drawn <= _CELLS_WITH_RATE else ""


def _ticks(side: Any, axis: Axis) -> None:
    if axis.labels:
        side.set_ticks(np.arange(axis.cells) + 0.5, [_plain(each) for each in axis.labels])
        return
    step = -(-len(axis.edges) // (_TICKS_MAX // 2 if axis.is_time else _TICKS_MAX))
    side.set_ticks(range(0, len(axis.edges), step), [axis.text(each) for each in axis.edges[::step]])


def _plain(text: str) -> str:
    """Return a recorded text without the signs that matplotlib reads as formulas."""
    return text.replace("$", r"\$")


def _draw_points(axes: Axes, samples: Samples) -> None:
    x, y = _places(samples.x, seed=0), _places(samples.y, seed=1)
    faint = max(0.15, min(0.9, 60 / len(x) ** 0.6))
    for succeeded, marker, color, label in ((False, "x", _ORANGE, "did not succeed"), (True, "o", _BLUE, "succeeded")):
        chosen = samples.succeeded == succeeded
        axes.scatter(
            x[chosen],
            y[chosen],
            s=22,
            marker=marker,
            c=color,
            alpha=faint,
            linewidths=1,
            rasterized=len(x) > 5_000,  # an SVG of 50,000 points has 10 MB
            label=f"{label}: {int(chosen.sum()):,}",
        )
    for side, values in ((axes.xaxis, samples.x), (axes.yaxis, samples.y)):
        if values.categories:
            side.set_ticks(range(len(values.categories)), [_plain(each) for each in values.categories])
    axes.grid(alpha=0.3)
    for handle in axes.legend(loc="best", fontsize=9).legend_handles:
        if handle is not None:
            handle.set_alpha(1)


def _places(values: Values, *, seed: int) -> NDArray[Any]:
    """Return the numbers; those of categories scattered, so that rows of one category do not cover each other."""
    if values.categories:
        return values.numbers + np.random.default_rng(seed).uniform(-0.3, 0.3, len(values.numbers))
    return (values.numbers * 1e6).astype("datetime64[us]") if values.is_time else values.numbers
