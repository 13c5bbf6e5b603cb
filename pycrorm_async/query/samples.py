"""Read the samples of a stream, such as joint states, as a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Observation, ObservationValue
from pycrorm_async.query.frames import imported
from pycrorm_async.query.question import AskedEpisode, episode_name
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest
from pycrorm_async.record.samples import TIME, table_of
from pycrorm_async.record.values import SAMPLES

if TYPE_CHECKING:
    import pandas as pd


async def read_samples(reading: Reading, /, stream: str, *, episode: AskedEpisode = "last") -> pd.DataFrame:
    """Return the samples of a stream of one episode (`RecordedEpisode.sampled`) as a frame of pandas, by time.

    >>> frame = await memory.samples("joint_states")
    >>> frame["shoulder"].max()

    The column `time` is in UTC, `ns` is the same time exactly, and each channel is a column of float64; NaN where a
    sample does not have it. `memory.ask.streams()` lists the streams. A stream needs 8 bytes of memory a number.

    Raises `UnknownEpisode`; `CallerError` for a stream that the episode does not have; `MissingExtra` without pandas.
    """
    pandas = imported("pandas")
    number = (await reading.episode(episode_name(episode))).number
    observation, value = Observation, ObservationValue
    sampled = (
        select(observation.name, value.blob)
        .join(value, value.id == observation.id)
        .where(observation.process_metadata_id == number, value.media_type == SAMPLES)
        .order_by(observation.id)
    )
    blocks = await reading.rows(sampled.where(observation.name == stream), simulated=True)
    if not blocks:
        names = sorted({name for name, _ in await reading.rows(sampled, simulated=True)})
        raise CallerError(f"episode {number} has no samples of {stream!r}{nearest(stream, names)}")
    frames = []
    for _, sha256 in blocks:
        blob = await reading.blob(sha256)
        if blob is None:
            raise CallerError(f"a block of {stream!r} is not stored: `pycrorm verify` names its event")
        frames.append(pandas.DataFrame(dict(table_of(blob.content))))
    frame: pd.DataFrame = pandas.concat(frames, ignore_index=True).sort_values(TIME, kind="stable", ignore_index=True)
    frame.insert(0, "time", pandas.to_datetime(frame[TIME], unit="ns", utc=True))
    return frame
