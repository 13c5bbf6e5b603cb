"""Draw episodes: a table of many, the facts of one, and its task tree with a chart."""

from __future__ import annotations

from collections.abc import Sequence

from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.notebook.gantt import gantt
from pycrorm_async.query.notebook.markup import facts, left_out, moment, quiet, recorded, status, table, view
from pycrorm_async.query.notebook.tree_view import NODES_MAX, tree_html
from pycrorm_async.query.parameter_text import duration

EPISODES_MAX = 100
"""Bounds the rows of a table of episodes."""
_COLUMNS = ("episode", "started, UTC", "took", "status", "nodes", "failed", "description", "robots", "tags")


def episodes_html(episodes: Sequence[EpisodeSummary], total: int | None = None) -> str:
    """Return a table of the newest episodes, the oldest of them first; `total` is the number of all in the memory."""
    if not episodes:
        return view("No episodes")
    count, shown = len(episodes) if total is None else total, episodes[-EPISODES_MAX:]
    more = f"<div>{left_out(count - len(shown), 'before these')}</div>" if len(shown) < count else ""
    return view(f"<b>{count:,} episode{'s' * (count > 1)}</b>", more, table(_COLUMNS, map(_row, shown)))


def _row(each: EpisodeSummary) -> tuple[str, ...]:
    return (
        str(each.number),
        moment(each.started_at),
        duration(each.duration_ns),
        status(each.status),
        f"{each.nodes:,}",
        f"{each.failed:,}" if each.failed else "",
        recorded(each.description, 100),
        recorded(", ".join(map(str, each.robots)), 60),
        recorded(", ".join(each.tags), 60),
    )


def episode_html(each: EpisodeSummary) -> str:
    """Return the facts of an episode."""
    commit = f"{each.git_commit}{' and changes' if each.git_dirty else ''}" if each.git_commit else ""
    return view(
        _title(each),
        facts(
            {
                "started": f"{moment(each.started_at)} UTC by {recorded(each.created_by)}",
                "took": duration(each.duration_ns),
                "nodes": f"{each.nodes:,}, {each.failed:,} failed",
                "robots": recorded(", ".join(map(str, each.robots))) if each.robots else "",
                "tags": recorded(", ".join(each.tags)) if each.tags else "",
                "metadata": recorded(each.metadata) if each.metadata else "",
                "plan": recorded(each.plan) if each.plan else "",
                "commit": recorded(commit) if commit else "",
                "world": recorded(each.world) if each.world else "",
                "simulated by": f"a node of episode {each.thought_by.episode}" if each.thought_by else "",
                "id": each.id,
            }
        ),
    )


def _title(each: EpisodeSummary) -> str:
    simulated = f" {quiet('simulated')}" if each.simulated else ""
    return f"<b>Episode {each.number} · {recorded(each.description)}</b> · {status(each.status)}{simulated}"


def task_tree_html(nodes: Sequence[NodeSummary], episode: EpisodeSummary | None) -> str:
    """Return the title of the episode, a chart of its nodes over events, and the nodes as nested lists."""
    count = f"{len(nodes):,} node{'s' * (len(nodes) != 1)}"
    if episode is None:
        title = f"<b>{count}</b>"
    else:
        took = f" {duration(episode.duration_ns)}" if episode.duration_ns is not None else ""
        title = f"{_title(episode)}{took} · {count}"
    if not nodes:
        return view(title)
    more = f"<div>{left_out(len(nodes) - NODES_MAX, 'nodes than drawn')}</div>" if len(nodes) > NODES_MAX else ""
    chart = f'<div style="max-height:340px;overflow:auto;margin:6px 0">{gantt(nodes).svg}</div>'
    return view(title, more, chart, tree_html(nodes))
