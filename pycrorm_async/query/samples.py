"""Read the samples of a stream, such as joint states, as a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import select

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.orm import Observation, ObservationValue
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
    try:
        import pandas as pd
    except ImportError:
        raise MissingExtra("frames need pandas: pip install 'pycrorm-async[frames]'") from None
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
        frames.append(pd.DataFrame(dict(table_of(blob.content))))
    frame = pd.concat(frames, ignore_index=True).sort_values(TIME, kind="stable", ignore_index=True)
    times: Any = frame[TIME].to_numpy().astype("datetime64[ns]")
    frame.insert(0, "time", pd.Series(times, dtype=np.dtype("datetime64[ns]")).dt.tz_localize("UTC"))
    return frame
