"""Count and draw how often actions succeeded, over any two columns of a view."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from datetime import UTC, datetime
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, Text, column, inspect, select, table, type_coerce
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.orm import DeclarativeBase

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.orm import Designator
from pycrorm_async.orm.base import EPISODE, Base, is_built_in, view_mappers
from pycrorm_async.orm.documentation import unit_of
from pycrorm_async.query.frames import NORMAL_95, TRIED, FrameColumn, columns_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest, one_line
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# === figure ===================================================================================================
#
# Draw successes over two columns by matplotlib: the rates of cells as a heat map, or each row as a point.

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
    left_out += [f"{table.running:,} neither succeeded nor failed"] if table.running else []
    more = f"; left out: {', '.join(left_out)}" if left_out else ""
    return _plain(f"{table.source}: success over {table.x.name} and {table.y.name}\n{rate}{more}")


def _percent(*rates: float) -> str:
    return f"{' to '.join(f'{100 * each:.3g}' for each in rates)} %"


def _draw_cells(axes: Axes, table: SuccessTable) -> None:
    from matplotlib.patches import Rectangle

    rates = np.full((table.y.cells, table.x.cells), np.nan)
    for cell in table.cells:
        rates[cell.y, cell.x] = cell.rate
    mesh = axes.pcolormesh(rates, cmap="viridis", vmin=0, vmax=1, edgecolors="white", linewidth=0.5)
    figure = axes.get_figure(root=True)
    assert figure is not None, "axes belong to a figure"
    figure.colorbar(mesh, ax=axes, shrink=0.8, label="share of successes; hatched: fewer than 5 rows")
    cells_drawn = table.x.cells * table.y.cells
    for cell in table.cells:
        color = "white" if cell.rate < 0.6 else "black"
        if cell.rows < _FEW:
            place = cell.x, cell.y
            axes.add_patch(Rectangle(place, 1, 1, fill=False, hatch="///", edgecolor=color, linewidth=0, alpha=0.3))
        if text := _text(cell, cells_drawn):
            size = 9 if cells_drawn <= _CELLS_WITH_INTERVAL else 7 if cells_drawn <= _CELLS_WITH_COUNT / 2 else 5.5
            axes.text(cell.x + 0.5, cell.y + 0.5, text, ha="center", va="center", color=color, fontsize=size)
    _ticks(axes.xaxis, table.x)
    _ticks(axes.yaxis, table.y)
    if table.x.edges and table.y.edges and math.isclose(table.x.step, table.y.step):
        axes.set_aspect("equal")
    if table.x.labels and max(map(len, table.x.labels)) * table.x.cells > 70:
        axes.tick_params(axis="x", rotation=45)


def _text(cell: Cell, cells_drawn: int) -> str:
    rate = f"{100 * cell.rate:.0f} %"
    if cells_drawn <= _CELLS_WITH_INTERVAL:
        low, high = cell.interval
        return f"{rate}\n{100 * low:.0f} to {100 * high:.0f} %\nn = {cell.rows:,}"
    if cell.rows < _FEW and cells_drawn <= _CELLS_WITH_RATE:  # a rate would need its interval
        return f"{cell.succeeded}/{cell.rows}"
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
    # A success is a ring around the cross of a failure at the same place, so that neither hides the other.
    for succeeded, marker, color, label in ((False, "x", _ORANGE, "did not succeed"), (True, "o", _BLUE, "succeeded")):
        chosen = samples.succeeded == succeeded
        axes.scatter(
            x[chosen],
            y[chosen],
            s=48 if succeeded else 22,
            marker=marker,
            facecolors="none" if succeeded else color,
            edgecolors=color if succeeded else None,
            alpha=faint,
            linewidths=1.5,
            zorder=2 if succeeded else 3,
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


# === interval =================================================================================================
#
# Compute the 95 % interval of a success rate.


def interval_95(successes: float, tries: float) -> tuple[float, float]:
    """Return the interval by Wilson's score, which also holds for few tries and for rates near 0 and 1.

    >>> interval_95(11, 20)
    (0.3420853, 0.7418022)

    Without a try it is from 0 to 1.
    """
    if not tries:
        return 0.0, 1.0
    rate, spread = successes / tries, NORMAL_95**2 / tries
    middle = (rate + spread / 2) / (1 + spread)
    half = NORMAL_95 * math.sqrt(rate * (1 - rate) / tries + spread / (4 * tries)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


# === samples ==================================================================================================
#
# Read two columns and the status of a view's rows as samples: values, and whether each succeeded.

Source: TypeAlias = "str | type[DeclarativeBase] | Select[Any]"
"""A view, table, mapped class or designator type by name, a mapped class, or a select; with a column `status`."""

PICK_UPS = "PickUpWithContextView"
"""The view that is plotted by default."""

_ROWS_MAX = 1_000_000
"""Bounds the rows that are counted, which then take about 300 MB."""
_ROWS_AT_ONCE = 50_000
"""Bounds the rows that are fetched at once, and with it the memory."""
_CATEGORIES_MAX, _CATEGORY_MAX = 20, 24
"""Bounds the categories of a column, and their characters."""
_NUMBERS = ("integer", "number", "time", "local time", "date")
_CATEGORIES = ("bool", "text", "enum")
_SUCCEEDED = TaskStatus.SUCCEEDED.name
_UNTRIED = {None, *(each.name for each in TaskStatus if each not in TRIED)}


class Values(NamedTuple):
    """The values of one column.

    Attributes:
        numbers: of a numeric column; of another one the indices of `categories`.
        categories: in the order of an axis; empty for a numeric column.
        is_time: whether the numbers are seconds since 1970, UTC.
        unit: of the numbers, such as m; empty if it is not known.
    """

    name: str
    numbers: NDArray[np.float64]
    categories: tuple[str, ...] = ()
    is_time: bool = False
    unit: str = ""


class Samples(NamedTuple):
    """The rows that have both values and have ended.

    Attributes:
        source: name of the view.
        succeeded: for each row.
        missing: number of rows left out because a value is missing.
        running: number of rows left out because they neither succeeded nor failed: they run, or were cancelled,
            interrupted or lost.
    """

    source: str
    x: Values
    y: Values
    succeeded: NDArray[np.bool_]
    missing: int
    running: int


async def success_samples(
    reading: Reading, x: str, y: str, of: Source = PICK_UPS, *, episodes: Collection[int] | None = None
) -> Samples:
    """Return the samples of two columns, by name; with `episodes`, those of the episodes with these numbers.

    Raises `CallerError` for an unknown view or column, one that has no status or cannot be an axis, and if no row has
    both values and has ended.
    """
    await reading.refresh()
    async with reading.session() as session:
        connection = await session.connection()
        name, statement = await _statement(reading, connection, of)
        columns = {each.name: each for each in columns_of(statement, deferred=True)}
        wanted = [_column(each, columns, name) for each in (x, y, "status")]
        whole_class = statement.column_descriptions[0]["expr"]
        if isinstance(whole_class, type) and issubclass(whole_class, Designator):  # not that of a field `status`
            wanted[2] = wanted[2]._replace(expression=type_coerce(whole_class._status, Text()))  # noqa: SLF001
        if episodes is not None:
            statement = statement.where(_column(EPISODE, columns, name).expression.in_(episodes))
        plain = statement.with_only_columns(*(each.expression for each in wanted))
        rows: list[Any] = []
        async for part in (await connection.stream(plain)).partitions(_ROWS_AT_ONCE):
            rows += part
            if len(rows) > _ROWS_MAX:
                raise CallerError(f"{name} has more than {_ROWS_MAX:,} rows: choose some with a select")
    tried = [row for row in rows if row[2] not in _UNTRIED]
    whole = [row for row in tried if row[0] is not None and row[1] is not None]
    if not whole:
        raise CallerError(f"no row of {name} succeeded or failed and has {x} and {y}; it has {len(rows):,} rows")
    return Samples(
        name,
        _values(wanted[0], [row[0] for row in whole]),
        _values(wanted[1], [row[1] for row in whole]),
        np.array([row[2] == _SUCCEEDED for row in whole]),
        missing=len(tried) - len(whole),
        running=len(rows) - len(tried),
    )


async def _statement(reading: Reading, connection: AsyncConnection, of: Source) -> tuple[str, Select[Any]]:
    """Return the name and the select of a source."""
    if isinstance(of, Select):
        return "the select", of
    if not isinstance(of, str):
        return of.__name__, select(of)
    by_name = view_mappers() | {each.class_.__name__: each for each in Base.registry.mappers}
    mapped: dict[str, Any] = {name: each.class_ for name, each in by_name.items() if is_built_in(each.class_)}
    if of in mapped:
        return of, select(mapped[of])
    names = await connection.run_sync(lambda sync: inspect(sync).get_view_names())
    if of in names:
        described = await connection.run_sync(lambda sync: inspect(sync).get_columns(of))
        return of, select(*(column(each["name"], each["type"]) for each in described)).select_from(table(of))
    try:
        return of, select(reading.mapped(of))
    except CallerError:
        shown = [each for each in names if "__" not in each]
        raise CallerError(f"there is no view {of!r}{nearest(of, [*mapped, *shown])}") from None


def _column(name: str, columns: dict[str, FrameColumn], source: str) -> FrameColumn:
    if name == EPISODE and name not in columns:
        raise CallerError(f"{source} has no column {EPISODE}, so its rows cannot be counted for chosen episodes")
    if name not in columns:
        names = ", ".join(columns)
        reason = " whose success could be counted" if name == "status" else ""
        raise CallerError(f"{source} has no column {name!r}{reason}{nearest(name, columns)}; it has {names}")
    if columns[name].kind not in (*_NUMBERS, *_CATEGORIES, "untyped"):
        raise CallerError(f"{source}.{name} is of the type {columns[name].kind}, which cannot be an axis")
    return columns[name]


def _values(of: FrameColumn, values: Sequence[Any]) -> Values:
    kind = of.kind
    if kind == "untyped":
        kind = "number" if all(isinstance(each, int | float) for each in values) else "text"
    if kind in ("local time", "date"):
        return _categories(of.name, map(str, values))
    if kind in _CATEGORIES:
        return _categories(of.name, (str(bool(each)) if kind == "bool" else str(each) for each in values))
    if kind == "time":
        return Values(of.name, np.array(values, dtype=float) * 1e-6, is_time=True)
    return Values(of.name, np.array(values, dtype=float), unit=unit_of(of.expression))


def _categories(name: str, values: Iterable[str]) -> Values:
    """Return the values as categories in alphabetical order; rare ones of many as the category `n others`."""
    every = [one_line(each, _CATEGORY_MAX) or "(empty)" for each in values]
    counts = Counter(every)
    kept = sorted(counts)
    if len(kept) > _CATEGORIES_MAX:
        kept = sorted(each for each, _ in counts.most_common(_CATEGORIES_MAX - 1))
    index = {each: number for number, each in enumerate(kept)}
    numbers = np.array([index.get(each, len(kept)) for each in every], dtype=float)
    others = (f"{len(counts) - len(kept):,} others",) if len(counts) > len(kept) else ()
    return Values(name, numbers, (*kept, *others))


# === success table ============================================================================================
#
# Count successes in the cells of two axes: ranges of a numeric column, categories of another one.

_BINS_MAX = 200
"""Bounds the ranges of one axis."""
_BINS_LEAST, _BINS_USUAL = 4, 16
"""Bounds the default number of ranges of one axis, from below and above."""
_ROWS_A_CELL = 5
"""The rows that a cell has on average, from which the default number of ranges follows."""
_DAY_S, _MINUTE_S = 86_400, 60


class Axis(NamedTuple):
    """One axis.

    Attributes:
        labels: of the categories; empty for a numeric column.
        edges: of the ranges, one more than there are cells; empty for categories.
        unit: of the edges; empty if it is not known.
    """

    name: str
    labels: tuple[str, ...] = ()
    edges: tuple[float, ...] = ()
    is_time: bool = False
    unit: str = ""

    @property
    def cells(self) -> int:
        """The number of cells along it."""
        return len(self.labels) or len(self.edges) - 1

    @property
    def step(self) -> float:
        """The width of a range."""
        return self.edges[1] - self.edges[0]

    def text(self, edge: float) -> str:
        """Format an edge."""
        if not self.is_time:
            return f"{edge + 0.0:.6g}"
        when = datetime.fromtimestamp(edge, UTC)
        if self.step >= _DAY_S:
            return f"{when:%Y-%m-%d}"
        return f"{when:%m-%d %H:%M}" if self.step >= _MINUTE_S else f"{when:%H:%M:%S.%f}"[:-4]

    def cell_text(self, cell: int) -> str:
        """Format a cell: its category, or its range."""
        if self.labels:
            return self.labels[cell]
        return f"{self.text(self.edges[cell])} to {self.text(self.edges[cell + 1])}"


class Cell(NamedTuple):
    """A cell with at least one row: its place along both axes, and how many of its rows succeeded."""

    x: int
    y: int
    succeeded: int
    rows: int

    @property
    def rate(self) -> float:
        """The share of successes."""
        return self.succeeded / self.rows

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the rate."""
        return interval_95(self.succeeded, self.rows)


class SuccessTable(NamedTuple):
    """The successes over two axes; `missing` and `running` are those of `Samples`."""

    source: str
    x: Axis
    y: Axis
    cells: tuple[Cell, ...]
    succeeded: int
    rows: int
    missing: int
    running: int


def success_table(samples: Samples, *, bins: int | None = None) -> SuccessTable:
    """Count the samples in at most about `bins` ranges of each numeric column, with round edges.

    By default the number of ranges grows with the number of rows. Raises `CallerError`.
    """
    if bins is None:
        usual = round(math.sqrt(len(samples.succeeded) / _ROWS_A_CELL))
        bins = min(max(usual, _BINS_LEAST), _BINS_USUAL)
    if not 1 <= bins <= _BINS_MAX:
        raise CallerError(f"bins must be 1 to {_BINS_MAX}, got {bins}")
    x, columns = _axis(samples.x, bins)
    y, rows = _axis(samples.y, bins)
    counts = np.zeros((2, x.cells, y.cells), dtype=int)
    np.add.at(counts, (samples.succeeded.astype(int), columns, rows), 1)
    failed, succeeded = counts
    cells = tuple(
        Cell(int(i), int(j), int(succeeded[i, j]), int(succeeded[i, j] + failed[i, j]))
        for i, j in np.argwhere(succeeded + failed)
    )
    total = int(samples.succeeded.sum())
    return SuccessTable(samples.source, x, y, cells, total, len(samples.succeeded), samples.missing, samples.running)


def _axis(values: Values, bins: int) -> tuple[Axis, NDArray[np.int64]]:
    """Return the axis of a column, and the cell of each value along it."""
    if values.categories:
        return Axis(values.name, values.categories), values.numbers.astype(np.int64)
    low, high = float(values.numbers.min()), float(values.numbers.max())
    step = _round_step((high - low) / bins) if high > low else max(abs(low) * 1e-3, 1.0)
    first = math.floor(low / step)
    last = max(math.ceil(high / step), first + 1)
    edges = tuple(index * step for index in range(first, last + 1))
    cells = np.clip(np.floor(values.numbers / step).astype(np.int64) - first, 0, last - first - 1)
    return Axis(values.name, edges=edges, is_time=values.is_time, unit=values.unit), cells


def _round_step(width: float) -> float:
    """Return the least of 1, 2, 2.5, 5 and 10, times a power of ten, that is not below the width."""
    power = 10.0 ** math.floor(math.log10(width))
    return next((factor * power for factor in (1, 2, 2.5, 5) if factor * power >= width * (1 - 1e-9)), 10 * power)


# === plot =====================================================================================================


async def plot_success(
    reading: Reading,
    x: str,
    y: str,
    *,
    of: Source = PICK_UPS,
    kind: Kind = "auto",
    bins: int | None = None,
    axes: Axes | None = None,
) -> Figure:
    """Draw how often the actions of a view succeeded over two of its columns, up to the last flush.

    >>> figure = await memory.plot_success("relative_x", "relative_y")  # pick-ups, as in the thesis' figure 5.1
    >>> figure.savefig("pick-ups.svg")
    >>> await memory.plot_success("arm", "duration", of=PickUpAction, axes=axes)

    Args:
        x, y: names of columns: numbers, times, texts, enums or bools.
        of: the view: a mapped class, the name of one or of a view or designator type, or a select with a column
            `status`.
        kind: `heatmap` of the share of successes, with the number of rows and the 95 % interval in cells that are
            large enough; `scatter` of the rows; by default a scatter of up to 500 rows with two numbers.
        bins: the largest number of ranges of a numeric column; by default it grows with the number of rows.
        axes: draw into these instead of a new figure.

    It needs the extra `pictures`. Raises `CallerError` for an unknown view or column, and if no row is left.
    """
    samples = await success_samples(reading, x, y, of)
    return success_figure(samples, kind=kind, bins=bins, axes=axes)
