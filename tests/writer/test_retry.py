from __future__ import annotations

from pycrorm_async.writer.drain import Backoff


def test_each_pause_is_twice_the_previous_one_up_to_the_longest() -> None:
    backoff = Backoff(first_s=0.5, longest_s=5.0)
    assert [backoff.pause_s(attempt, 1.0) for attempt in range(1, 7)] == [0.5, 1.0, 2.0, 4.0, 5.0, 5.0]


def test_jitter_takes_up_to_half_of_a_pause() -> None:
    backoff = Backoff(first_s=0.5, longest_s=5.0)
    assert [backoff.pause_s(3, randomness) for randomness in (0.0, 0.5, 1.0)] == [1.0, 1.5, 2.0]


def test_a_policy_without_a_last_attempt_continues_for_years() -> None:
    assert Backoff(first_s=0.5, longest_s=5.0).pause_s(10**9, 1.0) == 5.0


def test_a_policy_with_a_last_attempt_ends_at_it() -> None:
    backoff = Backoff(first_s=1.0, longest_s=5.0, attempts_max=3)
    assert [backoff.pause_s(attempt, 1.0) for attempt in (1, 2, 3, 4)] == [1.0, 2.0, None, None]
