"""Successes are counted exactly over two columns of any view, and drawn; what cannot be drawn is one line."""

from __future__ import annotations

import asyncio
import builtins
import io
import json
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from matplotlib.figure import Figure
from sqlalchemy import select
from typer.testing import CliRunner

from pycrorm_async import Memory, UserView
from pycrorm_async.cli.main import app
from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.events.types import NodeStatus
from pycrorm_async.orm import Action, PickUpWithContextView
from pycrorm_async.orm.documentation import unit_of
from pycrorm_async.query import success as figures
from pycrorm_async.query.success import Samples, Values, interval_95, success_figure, success_samples, success_table

pytestmark = pytest.mark.slow

TRIED = UserView("tried", select(Action.dtype, Action.status, Action.sequence.label("event")))


async def record(url: str) -> None:
    async with Memory.open(url, views=[TRIED]) as memory:
        type_ = memory.recording.type(
            "action", "TryAction", {"speed": float, "arm": str, "tool": str, "extra": list[int]}
        )
        with memory.recording.episode(description="tries") as episode:
            for number, (speed, arm) in enumerate(product((0.1, 0.2, 0.9), ("left", "right", "$x_1$"))):
                values: dict[str, Any] = {"speed": speed, "arm": arm, "tool": f"tool {number}", "extra": [1]}
                if number == 8:
                    del values["speed"]
                episode.start(str(number), type_, values)
                episode.end(str(number), "SUCCEEDED" if arm == "left" else "FAILED", "slipped")
        await memory.flush()


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('success')}/memory.db"
    asyncio.run(record(address))
    return address


def samples(x: list[float], y: Values, succeeded: list[bool]) -> Samples:
    return Samples("View", Values("x", np.array(x)), y, np.array(succeeded), 0, 0)


def test_cells_count_their_rows_in_ranges_with_round_edges() -> None:
    y = Values("arm", np.array([0.0, 1.0, 0.0, 0.0, 1.0]), ("left", "right"))
    table = success_table(samples([0.03, 0.41, 0.99, 0.98, 1.0], y, [True, False, True, False, True]), bins=5)
    assert table.x.edges == pytest.approx((0.0, 0.2, 0.4, 0.6, 0.8, 1.0))
    assert [tuple(each) for each in table.cells] == [(0, 0, 1, 1), (2, 1, 0, 1), (4, 0, 1, 2), (4, 1, 1, 1)]
    assert (table.succeeded, table.rows) == (3, 5)
    assert [table.x.cell_text(2), table.y.cell_text(1)] == ["0.4 to 0.6", "right"]


def test_every_row_is_in_a_cell_whatever_the_range() -> None:
    for values in ([2.0, 2.0], [0.0, 0.0], [1e-12, 2e-12], [1e300, -1e300]):
        table = success_table(samples(values, Values("y", np.array([1.0, 1.0])), [True, False]))
        assert sum(each.rows for each in table.cells) == 2
        assert 1 <= table.x.cells <= 20
        assert table.x.edges[0] <= min(values) <= max(values) <= table.x.edges[-1]


def test_the_interval_is_that_of_wilson() -> None:
    assert interval_95(5, 5) == pytest.approx((0.56551, 1.0), abs=1e-5)
    assert interval_95(0, 10) == pytest.approx((0.0, 0.27753), abs=1e-5)
    assert interval_95(7_900, 50_000) == pytest.approx((0.15483, 0.16122), abs=1e-5)  # the thesis' default policy
    assert interval_95(0, 0) == (0.0, 1.0)


async def test_rows_without_a_value_or_an_end_are_counted_and_left_out(url: str) -> None:
    async with Memory.open(url) as memory:
        read = await success_samples(memory.reading, "speed", "arm", "TryAction")
    assert (len(read.succeeded), read.missing, read.running) == (8, 1, 0)
    assert read.y.categories == ("$x_1$", "left", "right")
    assert sorted(read.x.numbers[read.succeeded].tolist()) == [0.1, 0.2, 0.9]
    async with Memory.open("sqlite://") as memory:
        with memory.recording.episode(description="running") as episode:
            episode.start("1", memory.recording.type("action", "TryAction", {"speed": float}), {"speed": 1.0})
            await memory.flush()
            with pytest.raises(CallerError, match="succeeded or failed and has speed and dtype; it has 1 rows"):
                await memory.plot_success("speed", "dtype", of="TryAction")
            type_ = memory.recording.type("action", "TryAction", {"speed": float})
            for status in set(get_args(NodeStatus)) - {"RUNNING"}:
                episode.start(status, type_, {"speed": 2.0})
                episode.end(status, status)
            await memory.flush()
            [rate] = await memory.ask.success_rates().rows()
            tried = await success_samples(memory.reading, "speed", "dtype", "TryAction")
            assert (rate.succeeded, rate.failed) == (1, 2)
            assert (len(tried.succeeded), tried.succeeded.sum()) == (3, 1)
            assert tried.running == rate.times - 3


async def test_a_view_is_a_class_a_name_a_view_of_the_users_own_or_a_select(url: str) -> None:
    async with Memory.open(url) as memory:
        for of in (Action, "Action", "action", select(Action), "tried"):
            read = await success_samples(memory.reading, "dtype", "event" if of == "tried" else "sequence", of)
            assert (len(read.succeeded), int(read.succeeded.sum())) == (9, 3)
            assert read.x.categories == ("TryAction",)
        few = await success_samples(memory.reading, "dtype", "sequence", select(Action).limit(2))
        assert len(few.succeeded) == 2
        times = await success_samples(memory.reading, "start_time", "duration", Action)
        assert times.x.is_time
        assert 1.6e9 < times.x.numbers.min() < 4e9


async def test_the_labels_of_a_picture_have_the_units_that_the_schema_has(url: str) -> None:
    async with Memory.open(url) as memory:
        timed = await memory.plot_success("start_time", "duration", of=Action)
        speeds = await memory.plot_success("speed", "tool", of="TryAction")
    labels = [(each.axes[0].get_xlabel(), each.axes[0].get_ylabel()) for each in (timed, speeds)]
    assert labels == [("start_time, UTC", "duration, s"), ("speed", "tool")]
    columns = ("relative_x", "object_z", "torso_height", "height_over_torso", "arm", "id")
    assert [unit_of(PickUpWithContextView.__table__.c[each]) for each in columns] == ["m", "m", "m", "m", "", ""]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sped", "arm", "TryAction"), "TryAction has no column 'sped'; did you mean speed"),
        (("speed", "arm", "TriAction"), "there is no view 'TriAction'"),
        (("x", "y", "Pose"), "Pose has no column 'status' whose success could be counted"),
        (("speed", "parameters", "TryAction"), "TryAction.parameters is of the type json, which cannot be an axis"),
        (("relative_x", "relative_y"), "no row of PickUpWithContextView succeeded or failed and has relative_x and"),
    ],
)
async def test_what_cannot_be_counted_is_one_line(url: str, arguments: tuple[str, ...], message: str) -> None:
    async with Memory.open(url) as memory:
        with pytest.raises(CallerError, match=message):
            await memory.plot_success(*arguments[:2], of=arguments[2]) if arguments[2:] else await memory.plot_success(
                *arguments
            )


def test_of_many_categories_the_rare_ones_are_counted_together() -> None:
    from pycrorm_async.query.success import _categories

    names = [f"c{number:03}" for number in range(100) for _ in range(2 if number < 19 else 1)]
    values = _categories("tool", names)
    assert values.categories == (*(f"c{number:03}" for number in range(19)), "81 others")
    assert int((values.numbers == 19).sum()) == 81


async def test_a_figure_has_a_text_in_each_cell_or_a_point_for_each_row(url: str) -> None:
    async with Memory.open(url) as memory:
        drawn = await memory.plot_success("speed", "arm", of="TryAction")
        own = Figure()
        axes = own.add_subplot()
        points = await memory.plot_success("speed", "tool", of="TryAction", kind="scatter", axes=axes)
        with pytest.raises(CallerError, match="kind must be 'auto', 'heatmap' or 'scatter', got 'pie'"):
            await memory.plot_success("speed", "arm", of="TryAction", kind="pie")  # type: ignore[arg-type]
        with pytest.raises(CallerError, match="bins must be 1 to 200, got 0"):
            await memory.plot_success("speed", "arm", of="TryAction", bins=0)
    assert [each.get_text() for each in drawn.axes[0].texts].count("100 %\n21 to 100 %\nn = 1") == 3
    assert "37.5 % of 8 succeeded" in drawn.axes[0].get_title(loc="left")
    assert "left out: 1 without a value" in drawn.axes[0].get_title(loc="left")
    assert drawn._repr_png_()[1:4] == b"PNG"  # type: ignore[attr-defined]
    assert points is own
    assert [np.shape(each.get_offsets())[0] for each in axes.collections] == [5, 3]
    own.savefig(io.BytesIO())


def test_a_cell_of_fewer_than_five_rows_is_hatched() -> None:
    arms = Values("arm", np.array([0.0] * 4 + [1.0] * 5), ("left", "right"))
    drawn = success_figure(samples([1.0] * 9, arms, [True] * 9), kind="heatmap")
    hatched = [each for each in drawn.axes[0].patches if each.get_hatch()]
    assert [each.get_y() for each in hatched] == [0]  # type: ignore[attr-defined]


def test_without_matplotlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return imported(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    figures._figure_type.cache_clear()
    with pytest.raises(MissingExtra, match=r"pip install 'pycrorm-async\[pictures\]'"):
        success_figure(samples([1.0], Values("y", np.array([1.0])), [True]))


def test_the_command_writes_the_picture_and_prints_the_counts(url: str, tmp_path: Path) -> None:
    out = tmp_path / "tries.svg"
    command = ["plot", "speed", "arm", "--of", "TryAction", "--bins", "2", "--url", url, "--out", str(out)]
    done = CliRunner().invoke(app(), [*command, "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert {name: document[name] for name in ("view", "succeeded", "rows", "missing", "running")} == {
        "view": "TryAction",
        "succeeded": 3,
        "rows": 8,
        "missing": 1,
        "running": 0,
    }
    assert document["cells"][0] == {
        "speed": "0 to 0.5",
        "arm": "$x_1$",
        "succeeded": 0,
        "rows": 2,
        "interval": [0.0, 0.658],
    }
    assert out.read_text().startswith("<?xml")
    assert "exists: add --force" in CliRunner().invoke(app(), command).stderr
    assert CliRunner().invoke(app(), [*command, "--force"]).exit_code == 0
    wrong = CliRunner().invoke(app(), [*command[:-1], "tries.doc"])
    assert (wrong.exit_code, "must end in one of .png, .svg, .pdf" in wrong.stderr) == (2, True)
