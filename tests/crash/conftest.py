"""The process with a faulty disk, one for each module that needs it."""

import shutil
from collections.abc import Iterator

import pytest

from tests.crash.faulty_disk import DiskProcess


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DiskProcess]:
    """Return the process from which plans on a faulty disk are forked; skip the test without a C compiler."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc is installed")
    running = DiskProcess(tmp_path_factory.mktemp("disk"))
    yield running
    running.close()
