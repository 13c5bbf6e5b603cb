"""File locks: one holder at a time, released when the holder dies, and never held by a forked child."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pycrorm_async.queue.locks import FileLock, is_locked


def test_a_lock_has_one_holder_and_can_be_taken_after_its_release(tmp_path: Path) -> None:
    path = tmp_path / "alive"
    assert is_locked(path) is False
    first = FileLock.take(path)
    assert first is not None
    assert is_locked(path) is True
    assert FileLock.take(path) is None
    first.release()
    first.release()
    assert is_locked(path) is False
    second = FileLock.take(path, create=False)
    assert second is not None
    second.release()


def test_a_missing_lock_file_is_made_only_on_request(tmp_path: Path) -> None:
    assert FileLock.take(tmp_path / "alive", create=False) is None
    assert list(tmp_path.iterdir()) == []


def test_the_kernel_releases_the_lock_of_a_killed_holder(tmp_path: Path) -> None:
    path = tmp_path / "alive"
    program = (
        "import sys, pathlib; from pycrorm_async.queue.locks import FileLock;"
        "lock = FileLock.take(pathlib.Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen([sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        assert is_locked(path) is True
        holder.send_signal(signal.SIGSTOP)
        assert FileLock.take(path) is None
        holder.kill()
        holder.wait()
    assert is_locked(path) is False


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_neither_keeps_nor_releases_a_lock(tmp_path: Path) -> None:
    path = tmp_path / "alive"
    lock = FileLock.take(path)
    assert lock is not None
    begin_read, begin_write = os.pipe()
    child = os.fork()
    if child == 0:
        lock.release()  # already closed: the child must not unlock what the parent holds
        os.read(begin_read, 1)
        os._exit(0)
    try:
        assert is_locked(path) is True
        lock.release()
        assert is_locked(path) is False
    finally:
        os.write(begin_write, b"x")
        os.waitpid(child, 0)
        os.close(begin_read)
        os.close(begin_write)


def test_a_lock_whose_file_was_deleted_meanwhile_is_not_taken(tmp_path: Path) -> None:
    """Between open and lock the previous holder may delete the file, so that the lock would protect nothing."""
    path = tmp_path / "alive"
    held = FileLock.take(path)
    assert held is not None
    path.unlink()
    assert FileLock.take(path, create=False) is None
    again = FileLock.take(path)
    assert again is not None
    held.release()
    assert is_locked(path) is True
    again.release()
