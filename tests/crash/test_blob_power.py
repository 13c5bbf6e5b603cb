"""A power cut before and after every sync takes no blob that a surviving record refers to.

The machine is that of `test_queue_power`. A blob whose file was not synced may be missing, empty, zero or whole after a
cut, whatever the cut leaves of the record that refers to it.
"""

import random
import shutil
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import pytest

from pycrorm_async.events.types import references_in
from pycrorm_async.queue import blobs
from pycrorm_async.queue.blobs import is_whole
from tests.crash.test_queue_power import Machine, machine_on
from tests.queue.factories import ended, node, recover, started
from tests.queue.test_blobs import OBSERVED, referring

pytestmark = pytest.mark.slow


class BlobMachine:
    """A machine whose cuts take blobs that were not synced."""

    def __init__(self, machine: Machine, rng: random.Random, patch: pytest.MonkeyPatch) -> None:
        self.machine = machine
        self._rng = rng
        self._synced: set[str] = set()
        sync_file, cut = blobs._sync_file, machine.cut

        def sync(path: Path) -> None:
            machine.cut()
            sync_file(path)
            self._synced.add(path.name)
            machine.cut()

        def cut_with_blobs() -> None:
            cut()
            self._keep_some(machine.cuts[-1][0] / "blobs")

        patch.setattr(blobs, "_sync_file", sync)
        patch.setattr(machine, "cut", cut_with_blobs)

    def put_referring(self) -> None:
        content = self._rng.randbytes(self._rng.randrange(1, 900))
        name = self.machine.queue.put_blob(content)
        assert name == sha256(content).hexdigest()
        self.machine.put(OBSERVED, referring(name, len(content)))
        self.machine.queue.release_blob(name)

    def _keep_some(self, target: Path) -> None:
        source = self.machine.queue.folder / "blobs"
        if not source.is_dir():
            return
        target.mkdir()
        for blob in source.iterdir():
            if blob.name in self._synced or self._rng.random() < 0.3:
                shutil.copy(blob, target / blob.name)
            elif self._rng.random() < 0.6:
                (target / blob.name).write_bytes(self._rng.choice([b"", bytes(blob.stat().st_size)]))


@pytest.fixture
def blob_machine(tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[BlobMachine]:
    rng = random.Random(seed)
    with machine_on(tmp_path, rng) as machine:
        yield BlobMachine(machine, rng, monkeypatch)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 60))])
async def test_a_record_that_survives_a_power_cut_has_its_blob_and_a_synced_one_survives(
    blob_machine: BlobMachine, seed: int
) -> None:
    rng, machine = random.Random(seed + 3000), blob_machine.machine
    machine.put(started(1), b"{}")
    machine.put(started(2), b"{}")
    for _ in range(6):
        for _ in range(rng.randrange(1, 5)):
            if rng.random() < 0.5:
                blob_machine.put_referring()
            else:
                machine.put(node(2), b"n" * rng.randrange(900))
        machine.cut()
        machine.turn()
        machine.cut()
        if machine.queue.synced > machine.queue._source.reader.cursor.position and rng.random() < 0.5:
            batch = await machine.queue.get_batch(events_max=rng.choice([1, 4, 1000]), bytes_max=2**20, age_s_max=0.0)
            await machine.queue.acknowledge(batch[-1].position)
            machine.turn()
            machine.cut()
    machine.put(ended(1), b"{}")
    machine.cut()

    referred = 0
    for folder, synced, stored, _ in machine.cuts:
        records = await recover(folder)
        kept = [each for each in records if each.payload != b'{"status":"LOST"}']
        last = kept[-1].position if kept else stored
        assert synced <= last
        for each in kept:
            for reference in references_in(each.type, each.payload):
                assert each.position <= stored or is_whole(folder, reference.hash), each.position
                referred += each.position > stored
    assert referred > 20
