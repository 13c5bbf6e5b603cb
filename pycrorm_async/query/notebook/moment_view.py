"""Draw the state of an episode at a moment: running nodes, the world from above, objects, observations and the tree."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from pycrorm_async.query.notebook.markup import left_out, moment, quiet, recorded, status, table, view
from pycrorm_async.query.notebook.tree_view import tree_html
from pycrorm_async.query.notebook.world_map import world_map
from pycrorm_async.query.parameter_text import parameters_text
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen

_ROWS_MAX = 100
"""Bounds the objects and the observations of a view, each."""


def moment_html(then: Moment) -> str:
    """Return the views of a moment below each other; the tree is closed."""
    simulated = f" {quiet('simulated')}" if then.simulated else ""
    title = (
        f"<b>Episode {then.number} · {recorded(then.description)}</b> at {then.time_s:.3f} s, event {then.sequence}"
        f" {quiet(f'({moment(then.at)} UTC)')} · {status(then.status)}{simulated}"
    )
    running = " → ".join(
        f"<b>{recorded(each.dtype or each.kind)}</b> {quiet(recorded(parameters_text(each.parameters), 80))}"
        for each in then.running
    )
    seen = list(then.observations.items())
    rows = [(recorded(name), recorded(_json(each.values)), f"e{each.sequence}") for name, each in seen[:_ROWS_MAX]]
    observed = [table(("observation", "values", "event"), rows), _more(len(seen), "observations")] if seen else []
    tree = f"<details><summary>{len(then.tree):,} nodes had started</summary>{tree_html(then.tree)}</details>"
    doing = f"<div>{running or quiet('nothing was running')}</div>"
    return view(title, doing, _world(then.world), *observed, tree)


def world_html(world: WorldThen) -> str:
    """Return the map of a world and the table of its objects."""
    return view(f"<b>{len(world.objects):,} object{'s' * (len(world.objects) != 1)}</b>", _world(world))


def _world(world: WorldThen) -> str:
    if not world.objects:
        return f"<div>{quiet('the world was empty at this moment')}</div>"
    columns = ("object", "type", "x, m", "y, m", "z, m", "heading", "attached to")
    rows = table(columns, map(_row, world.objects[:_ROWS_MAX]))
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start">'
        f'<div style="flex:1 1 300px;max-width:420px">{world_map(world).svg}</div>'
        f'<div style="flex:1 1 560px;min-width:0">{rows}{_more(len(world.objects), "objects")}</div></div>'
    )


def _row(each: ObjectThen) -> Sequence[str]:
    attached = ""
    if each.attached_to is not None:
        name, link = each.attached_to
        attached = recorded(name if link is None else f"{name}, {link}")
    position = (f"{value:.3f}" for value in each.pose.position)
    return recorded(each.name, 40), recorded(each.object_type), *position, _degrees(each.pose.yaw), attached


def _degrees(radians: float) -> str:
    return f"{round(math.degrees(radians)) + 0}°"


def _json(values: object) -> str:
    return msgspec.json.encode(values).decode()


def _more(count: int, noun: str) -> str:
    return f"<div>{left_out(count - _ROWS_MAX, noun)}</div>" if count > _ROWS_MAX else ""
