"""Make the random episodes about which all named questions are asked."""

from __future__ import annotations

from tests.query.random_memory import RandomEpisode

EPISODES = [RandomEpisode(number, seed=number) for number in range(1, 26)]
