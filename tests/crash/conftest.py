"""Random numbers from a printed seed, and the process with a faulty disk, one for each module that needs it."""

import os
import random
import shutil
from collections.abc import Iterator

import pytest

from tests.crash.faulty_disk import DiskProcess


@pytest.fixture
def rng() -> random.Random:
    seed = int(os.environ.get("PYCRORM_TEST_SEED") or random.SystemRandom().randrange(2**31))
    print(f"seed {seed}: PYCRORM_TEST_SEED={seed} takes it again")
    return random.Random(seed)


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DiskProcess]:
    """Return the process from which plans on a faulty disk are forked; skip the test without a C compiler."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc is installed")
    running = DiskProcess(tmp_path_factory.mktemp("disk"))
    yield running
    running.close()
