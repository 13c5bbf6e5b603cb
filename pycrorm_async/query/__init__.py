"""Query a memory: sessions, data frames, named queries, and snapshots of an episode at a moment."""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.query.named_queries import EpisodeSummary as EpisodeSummary
    from pycrorm_async.query.question import AskedEpisode as AskedEpisode
    from pycrorm_async.query.question import Question as Question
    from pycrorm_async.query.question import SyncQuestion as SyncQuestion
    from pycrorm_async.query.questions import Ask as Ask
    from pycrorm_async.query.reading import Reading as Reading
    from pycrorm_async.query.reading import memory_html as memory_html
    from pycrorm_async.query.samples import read_samples as read_samples
    from pycrorm_async.query.success import plot_success as plot_success

__getattr__ = lazy_names(
    __name__,
    {
        "named_queries": "EpisodeSummary",
        "question": "AskedEpisode Question SyncQuestion",
        "questions": "Ask",
        "reading": "Reading memory_html",
        "samples": "read_samples",
        "success": "plot_success",
    },
)
