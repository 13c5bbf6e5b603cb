"""Draw policies: the density of robot positions around the object under each policy, and the positions that worked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.learning.policies.policy import PickUpChoice, Policy

_SAMPLES = 200_000
"""The samples drawn for one plot, about 14 for each cell."""
_PLOT_RANGE_M = (-1.5, 1.5)
"""The plotted places of the base around the object along each axis, in m."""
_CELLS = 120
"""The cells along each axis of the plot, 2.5 cm wide."""


def draw_policies(
    policies: Mapping[str, Policy], path: Path | str, *, successes: Sequence[PickUpChoice] = (), seed: int = 0
) -> None:
    """Draw the policies side by side under their titles into a file whose suffix sets the format (.png, .svg, .pdf).

    The density over relative_x and relative_y, for all arms and grasps together, is that of 200,000 samples; the dots
    are the successes. Raises `MissingExtra` without matplotlib, `CallerError` if the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("a figure needs matplotlib: pip install 'pycrorm-async[learning]'") from None
    figure = Figure(figsize=(6 * len(policies), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(policies), squeeze=False)[0]
    for axes, (title, policy) in zip(panels, policies.items(), strict=True):
        drawn = policy.sample(np.random.default_rng(seed), _SAMPLES)
        *_, image = axes.hist2d(*_places(drawn), bins=_CELLS, range=(_PLOT_RANGE_M, _PLOT_RANGE_M), density=True)
        figure.colorbar(image, ax=axes, shrink=0.8, label="probability per m²")
        axes.plot(*_places(successes), ".", color="white", markersize=1.2, alpha=0.5)
        axes.plot(0, 0, "+", color="red", markersize=12)
        axes.set(title=title, xlabel="relative x, m (in the object's frame)", ylabel="relative y, m")
        axes.set(xlim=_PLOT_RANGE_M, ylim=_PLOT_RANGE_M, aspect="equal")
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise CallerError(f"cannot write the figure {path}: {error}") from None


def _places(choices: Sequence[PickUpChoice]) -> tuple[list[float], list[float]]:
    return [each.relative_x for each in choices], [each.relative_y for each in choices]
