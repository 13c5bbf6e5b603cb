"""`ReadableMemory` holds the queries of an open memory."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from datetime import datetime
from os import PathLike
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, overload

from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.errors import CallerError
from pycrorm_async.events.blobs import Blob
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.memory_parts import PartsHolder
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.asking.ask import Ask
from pycrorm_async.query.asking.episode_diff import EpisodeDiff
from pycrorm_async.query.asking.question import AskedEpisode, FrameQuery, Question
from pycrorm_async.query.frames.arrow_batches import BATCH_ROWS
from pycrorm_async.query.frames.dataframe import Library
from pycrorm_async.query.notebook.listings import Episodes, TaskTree
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.query.sql.read_only import DEFAULT_LIMITS, SqlLimits, SqlResult
from pycrorm_async.recall.reading.case_reader import CaseReader
from pycrorm_async.recall.reading.database_source import DatabaseSource
from pycrorm_async.recall.reading.recall import Recall
from pycrorm_async.recall.reading.running_cases import ProcessCases
from pycrorm_async.report.write import Report
from pycrorm_async.report.write import report as write_report

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pycrorm_async.export.export import ExportComparison, Exported, FileFormat
    from pycrorm_async.export.lerobot.images import ImageSize
    from pycrorm_async.export.lerobot.states import Clock
    from pycrorm_async.export.selection import Exportable
    from pycrorm_async.query.scene.picture import MomentReference
    from pycrorm_async.query.success.figure import Kind
    from pycrorm_async.query.success.samples import Source

__all__ = ["ReadableMemory"]


class ReadableMemory(PartsHolder):
    """The queries of a memory. Each raises `CallerError` while the memory is not open.

    "Up to the last flush" means that events recorded since the last `flush` may be missing from the result.
    """

    _recall: Recall | None = None

    def __repr__(self) -> str:
        return f"<Memory {self._address}, {'open' if self._parts is not None else 'not open'}>"

    def _repr_html_(self) -> str:
        from pycrorm_async.query.notebook.memory_view import memory_html

        return memory_html(self._address, self._located if self._parts is not None else None)

    @property
    def reading(self) -> Reading:
        """The reading side of this memory: named queries, sessions, data frames."""
        return self._open_parts.reading

    def session(self, *, simulated: bool = False) -> AbstractAsyncContextManager[AsyncSession]:
        """Return an ordinary SQLAlchemy `AsyncSession` on this memory, as an async context manager.

        With `simulated` it also sees simulations (`SimulatedTaskTree`).
        """
        return self._open_parts.reading.session(simulated=simulated)

    @overload
    async def dataframe(
        self,
        statement: FrameQuery,
        *,
        to: Literal["pandas"] = "pandas",
        simulated: bool = False,
        deferred: bool = False,
    ) -> pd.DataFrame: ...

    @overload
    async def dataframe(
        self,
        statement: FrameQuery,
        *,
        to: Library,
        simulated: bool = False,
        deferred: bool = False,
    ) -> Any: ...

    async def dataframe(
        self,
        statement: FrameQuery,
        *,
        to: Library = "pandas",
        simulated: bool = False,
        deferred: bool = False,
    ) -> Any:
        """Return the rows as a frame of pandas, polars or Arrow (extra `frames`), typed as the columns are declared.

        Args:
            statement: a select, a union of selects, a mapped class, or a question of `ask`.
            to: the library: `pandas`, `polars` or `arrow`.
            simulated: include the rows of simulations.
            deferred: include the columns of mapped classes that their objects load on request.
        """
        return await self._open_parts.reading.dataframe(statement, to=to, simulated=simulated, deferred=deferred)

    def batches(
        self,
        statement: FrameQuery,
        *,
        rows: int = BATCH_ROWS,
        simulated: bool = False,
        deferred: bool = False,
        enums_as_text: bool = False,
    ) -> AsyncGenerator[pa.RecordBatch]:
        """Return the rows as a stream of Arrow record batches of at most `rows` rows; see `Reading.batches`."""
        reading = self._open_parts.reading
        return reading.batches(
            statement, rows=rows, simulated=simulated, deferred=deferred, enums_as_text=enums_as_text
        )

    @property
    def ask(self) -> Ask[Question]:
        """The named questions: `await memory.ask.root_failures(object="milk")` is a frame, up to the last flush."""
        return self._open_parts.reading.ask

    async def diff(self, first: AskedEpisode, second: AskedEpisode) -> EpisodeDiff:
        """Compare two episodes, up to the last flush; see `Reading.diff`."""
        return await self._open_parts.reading.diff(first, second)

    @property
    def recall(self) -> Recall:
        """The past actions most like a cue: `await memory.recall(type=PickUpAction, has={"arm": Arms.LEFT})`."""
        parts = self._open_parts
        if self._recall is None:
            running = ProcessCases(
                parts.emitter,
                open_episodes=lambda: [*parts.recorder.episodes.by_id],
                flush=parts.flush,
                log=parts.reading.log,
                clock=self._clock,
            )
            reader = CaseReader(DatabaseSource(parts.reading), running)
            self._recall = Recall(reader, parts.reading, self._clock)
        return self._recall

    async def query(self, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> SqlResult:
        """Return the rows of one query in SQL that can only read, up to the last flush; see `Reading.query`."""
        return await self._open_parts.reading.query(sql, limits)

    def mapped(self, designator: str | type) -> Any:
        """Return the mapped class of a designator type, by its dtype or its class.

        The type is known after a flush of its first use. A memory with a daemon has no connection before its first
        query, so query it first.
        """
        reading = self._open_parts.reading
        if not reading.is_open:
            raise CallerError("this memory has not read its types yet: open a session first")
        return reading.mapped(designator)

    async def episodes(self, *, simulated: bool = False) -> Episodes:
        """Return every episode, the oldest first, up to the last flush, as a list that a notebook draws as a table."""
        return await self._open_parts.reading.episodes(simulated=simulated)

    async def tree(self, episode: AnyEpisode) -> TaskTree:
        """Return the task tree of an episode up to the last flush, as a list that a notebook draws; see `Reading.tree`.

        >>> tree = await memory.tree("last")
        >>> [node.dtype for node in tree if node.status == "FAILED"]
        """
        return await self._open_parts.reading.tree(episode)

    async def as_of(
        self,
        episode: AnyEpisode,
        *,
        time: float | datetime | None = None,
        sequence: int | None = None,
        meshes: bool = False,
    ) -> Moment:
        """Return the task tree and the world at any moment of an episode, up to the last flush; see `Reading.as_of`."""
        return await self._open_parts.reading.as_of(episode, time=time, sequence=sequence, meshes=meshes)

    async def report(
        self,
        episode: AnyEpisode,
        path: str | PathLike[str] | None = None,
        *,
        force: bool = False,
        first: int | None = None,
        last: int | None = None,
    ) -> Report:
        """Write an episode, up to the last flush, as one HTML file; see `pycrorm_async.report.write.report`."""
        reading = self._open_parts.reading
        return await write_report(reading, episode, path, force=force, first=first, last=last)

    async def picture(self, episode: AnyEpisode, *, at: MomentReference = None, **view: Any) -> bytes:
        """Return the scene of an episode at a moment as PNG, up to the last flush.

        >>> Path("scene.png").write_bytes(await memory.picture("last", at="e115"))

        `view` are the size and the camera, see `pycrorm_async.query.scene.picture.picture`. It needs the extra `world`.
        """
        from pycrorm_async.query.scene.picture import picture  # loads a world, which most programs have no need of

        return await picture(self._open_parts.reading, episode, at=at, **view)

    async def export(
        self,
        what: Exportable,
        path: str | PathLike[str],
        *,
        file_format: FileFormat | None = None,
        episodes: Sequence[str | int] = (),
        force: bool = False,
        arguments: Mapping[str, Any] = MappingProxyType({}),
        clock: Clock | None = None,
        fps: int | None = None,
        images: ImageSize | None = None,
    ) -> Exported:
        """Write episodes or rows to a file, up to the last flush; see `pycrorm_async.export.export.export`."""
        from pycrorm_async.export.export import export  # here, because most memories write no file

        return await export(
            self._open_parts.reading,
            what,
            path,
            file_format=file_format,
            episodes=episodes,
            arguments=arguments,
            force=force,
            clock=clock,
            fps=fps,
            images=images,
        )

    async def export_again(
        self,
        manifest: str | PathLike[str],
        path: str | PathLike[str] | None = None,
        *,
        statement: Question | Select[*tuple[Any, ...]] | None = None,
        force: bool = False,
    ) -> ExportComparison:
        """Make an export again from its manifest and compare; see `pycrorm_async.export.export.export_again`."""
        from pycrorm_async.export.export import export_again

        return await export_again(self._open_parts.reading, manifest, path, statement=statement, force=force)

    async def plot_success(
        self,
        x: str,
        y: str,
        *,
        of: Source = "PickUpWithContextView",
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
        from pycrorm_async.query.success.figure import success_figure
        from pycrorm_async.query.success.samples import success_samples

        samples = await success_samples(self._open_parts.reading, x, y, of)
        return success_figure(samples, kind=kind, bins=bins, axes=axes)

    async def blob(self, name: str) -> Blob | None:
        """Return the blob with this SHA-256, up to the last flush; None if it is not stored."""
        return await self._open_parts.reading.blob(name)

    async def number_of(self, episode: Episode) -> int:
        """Return the number that this database gave to the episode, after `flush`."""
        return await self._open_parts.reading.number_of(str(episode))
