"""Compute the statistics that LeRobot normalises with, of one episode and of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Statistics: TypeAlias = dict[str, NDArray[Any]]
"""The numbers of each statistic by its name: one for each channel of a feature, or a single one for `count`."""

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def statistics_of(values: NDArray[Any]) -> Statistics:
    """Return the statistics of a feature over the frames of an episode."""
    columns = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    return {
        "min": columns.min(axis=0),
        "max": columns.max(axis=0),
        "mean": columns.mean(axis=0),
        "std": columns.std(axis=0),
        "count": np.array([len(columns)]),
        **{name: np.quantile(columns, share, axis=0) for name, share in _QUANTILES.items()},
    }


def statistics_of_images(pictures: NDArray[np.uint8]) -> Statistics:
    """Return the statistics of each colour over all pixels, from 0 to 1, in the shape (3, 1, 1) that LeRobot has."""
    pixels = statistics_of(pictures.reshape(-1, 3) / 255)
    shaped = {name: each.reshape(3, 1, 1) for name, each in pixels.items() if name != "count"}
    return {**shaped, "count": np.array([len(pictures)])}


def joined(parts: Sequence[Statistics]) -> Statistics:
    """Return the statistics over several episodes; quantiles are the weighted means of theirs, as LeRobot has them."""
    counts = np.array([each["count"][0] for each in parts], dtype=np.float64)
    shares = (counts / counts.sum()).reshape(-1, *[1] * parts[0]["mean"].ndim)
    means = np.stack([each["mean"] for each in parts])
    mean = (means * shares).sum(axis=0)
    variances = np.stack([each["std"] for each in parts]) ** 2
    return {
        "min": np.stack([each["min"] for each in parts]).min(axis=0),
        "max": np.stack([each["max"] for each in parts]).max(axis=0),
        "mean": mean,
        "std": np.sqrt(((variances + (means - mean) ** 2) * shares).sum(axis=0)),
        "count": np.array([int(counts.sum())]),
        **{name: (np.stack([each[name] for each in parts]) * shares).sum(axis=0) for name in _QUANTILES},
    }
