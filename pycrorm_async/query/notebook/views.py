"""Register the view of each value that a memory returns.

The views are imported when a notebook draws one, because every command imports this module.
"""

from __future__ import annotations

from pycrorm_async.query.asking.episode_diff import EpisodeDiff
from pycrorm_async.query.asking.question import Question, SyncQuestion
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.snapshot import Moment, WorldThen
from pycrorm_async.query.sql.read_only import SqlResult
from pycrorm_async.query.value_html import value_html


@value_html.register(EpisodeSummary)
def _(episode: EpisodeSummary) -> str:
    from pycrorm_async.query.notebook.episode_view import episode_html

    return episode_html(episode)


@value_html.register(Moment)
def _(moment: Moment) -> str:
    from pycrorm_async.query.notebook.moment_view import moment_html

    return moment_html(moment)


@value_html.register(WorldThen)
def _(world: WorldThen) -> str:
    from pycrorm_async.query.notebook.moment_view import world_html

    return world_html(world)


@value_html.register(Question)
def _(question: Question) -> str:
    from pycrorm_async.query.notebook.answer_view import question_html

    return question_html(question.name, question.sql, "await it for a frame")


@value_html.register(SyncQuestion)
def _(question: SyncQuestion) -> str:
    from pycrorm_async.query.notebook.answer_view import question_html

    return question_html(question.name, question.sql, "call frame() or rows()")


@value_html.register(EpisodeDiff)
def _(diff: EpisodeDiff) -> str:
    from pycrorm_async.query.notebook.answer_view import diff_html

    return diff_html(diff)


@value_html.register(SqlResult)
def _(result: SqlResult) -> str:
    from pycrorm_async.query.notebook.answer_view import sql_result_html

    return sql_result_html(result)
