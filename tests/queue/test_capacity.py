"""Admission to the queue: files never exceed the limit, and the reserve is kept for reserved records."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.errors import CallerError
from pycrorm_async.queue.appender import Capacity
from pycrorm_async.settings import Settings

SMALL = Capacity(segment_bytes=1000, segments_max=5, reserve_bytes=500, episodes_max=10)


def test_an_empty_segment_holds_all_but_its_header_and_two_commits() -> None:
    assert SMALL.end == 1000 - 2 * 72
    assert SMALL.frame_bytes_max(episodes=0) == 1000 - 2 * 72 - 56
    assert SMALL.frame_bytes_max(episodes=3) == 1000 - 2 * 72 - 56 - 3 * 40


def test_ordinary_records_leave_the_reserve_free_in_the_last_segment() -> None:
    assert SMALL.ordinary_end(spare=4, episodes=0) == 856
    assert SMALL.ordinary_end(spare=0, episodes=0) == 856 - 500
    assert SMALL.admits(100, offset=256, spare=0, episodes=0, reserved=False)
    assert not SMALL.admits(101, offset=256, spare=0, episodes=0, reserved=False)
    assert SMALL.admits(600, offset=256, spare=0, episodes=0, reserved=True)
    assert not SMALL.admits(601, offset=256, spare=0, episodes=0, reserved=True)


def test_a_frame_that_does_not_fit_needs_a_segment_of_its_own() -> None:
    assert SMALL.admits(700, offset=800, spare=1, episodes=0, reserved=True)
    assert not SMALL.admits(700, offset=800, spare=0, episodes=0, reserved=True)
    assert not SMALL.admits(801, offset=800, spare=1, episodes=0, reserved=True)


@pytest.mark.slow
@given(st.integers(1, 2000), st.integers(56, 856), st.integers(0, 5), st.integers(0, 10), st.integers(1, 100))
def test_an_admitted_ordinary_record_is_also_admitted_as_reserved_and_with_more_space(
    frame_bytes: int, offset: int, spare: int, episodes: int, more: int
) -> None:
    if SMALL.admits(frame_bytes, offset=offset, spare=spare, episodes=episodes, reserved=False):
        assert SMALL.admits(frame_bytes, offset=offset, spare=spare, episodes=episodes, reserved=True)
        assert SMALL.admits(frame_bytes, offset=offset, spare=spare + more, episodes=episodes, reserved=False)


def test_settings_under_which_a_full_queue_could_never_be_emptied_are_refused() -> None:
    with pytest.raises(CallerError, match="three segments"):
        Capacity.of(Settings(segment_bytes=1000, spool_bytes_max=4000, spool_reserve_bytes=1001))


# The largest record: a header of 64 bytes, a type name of 255, the payload and padding; two commits of 72 after it; and
# before it the segment header, 56 bytes and 40 for each open episode.
LARGEST_OF_1000 = 64 + 1256
BESIDE_16_EPISODES = LARGEST_OF_1000 + 2 * 72 + 56 + 16 * 40


def test_the_largest_record_fits_beside_sixteen_open_episodes_or_the_settings_are_refused() -> None:
    enough = Settings(segment_bytes=BESIDE_16_EPISODES, record_bytes_max=1000)
    assert Capacity.of(enough).episodes_max == 16
    assert Capacity.of(enough).frame_bytes_max(episodes=16) == LARGEST_OF_1000
    with pytest.raises(CallerError) as refused:
        Capacity.of(replace(enough, segment_bytes=BESIDE_16_EPISODES - 1))
    assert str(refused.value) == (
        "segment_bytes (2,159) must hold a record of record_bytes_max (1,000) and 16 open episodes: 2,160 at least"
    )
    with pytest.raises(CallerError, match="record_bytes_max"):
        Capacity.of(Settings(segment_bytes=2**18))


def test_with_the_default_settings_the_limit_on_episodes_is_reached_last() -> None:
    episodes = (8 * 2**20 - 2 * 72 - 56 - 64 - (2**20 + 256)) // 40
    assert Capacity.of(Settings()) == Capacity(8 * 2**20, 512, 16 * 2**20, episodes)
    assert episodes > 180_000
