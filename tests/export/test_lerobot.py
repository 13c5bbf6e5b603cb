"""LeRobot data sets: their schema, their frames against the recorded events, and LeRobot's own loader."""

from __future__ import annotations

import errno
import io
import json
import sqlite3
import sys
from collections.abc import AsyncIterator
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from PIL import Image
from pyarrow import parquet

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import (
    Blob,
    EpisodeEnded,
    EpisodeStarted,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
)
from pycrorm_async.export.export import export, export_again
from pycrorm_async.export.lerobot_images import Camera
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.report.output_files import new_folder
from pycrorm_async.world import Pose
from tests.databases import run_in_own_loop
from tests.full_disk import files_of_at_most
from tests.projections.event_script import NAVIGATE, SAYING, Script, append_and_fold, declarations, name_of, pose
from tests.shared_folders import made_once

SCHEMA = json.loads(Path(__file__).with_name("lerobot_v3.json").read_text())


async def _export(memory: Path, dataset: Path) -> None:
    async with Reading.open(f"sqlite:///{memory}/pycrorm.db") as reading:
        exported = await export(reading, ["1", "2"], dataset, file_format="lerobot")
    assert exported.rows == parquet.read_metadata(dataset / "data/chunk-000/file-000.parquet").num_rows


@pytest.fixture
def dataset(kitchen: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a data set of the episodes 1 and 2, by event."""
    folder = made_once(
        tmp_path_factory, "dataset", lambda folder: run_in_own_loop(_export(kitchen, folder / "kitchen"))
    )
    return folder / "kitchen"


def types_of(path: Path) -> dict[str, str]:
    return {each.name: str(each.type) for each in parquet.read_schema(path)}


def test_files_columns_and_keys_are_those_of_the_committed_description(dataset: Path) -> None:
    assert sorted(str(each.relative_to(dataset)) for each in dataset.rglob("*.*")) == sorted(SCHEMA["files"])
    info = json.loads((dataset / "meta/info.json").read_text())
    assert {*info} == {*SCHEMA["info"]}
    assert {name: info[name] for name, value in SCHEMA["info"].items() if value is not None} == {
        name: value for name, value in SCHEMA["info"].items() if value is not None
    }
    width = info["features"]["action"]["shape"][0]
    assert len(info["features"]["action"]["names"]) == width
    expected = {name: type_.replace("WIDTH", str(width)) for name, type_ in SCHEMA["data"].items()}
    assert types_of(dataset / "data/chunk-000/file-000.parquet") == expected
    assert {name: each["dtype"] for name, each in info["features"].items()} == SCHEMA["features"]
    episodes = types_of(dataset / "meta/episodes/chunk-000/file-000.parquet")
    assert {name: each for name, each in episodes.items() if not name.startswith("stats/")} == SCHEMA["episodes"]
    statistics = json.loads((dataset / "meta/stats.json").read_text())
    assert {*statistics} == {*SCHEMA["features"]}
    assert all([*each] == SCHEMA["statistics"] for each in statistics.values())
    assert {name for name in episodes if name.startswith("stats/")} == {
        f"stats/{name}/{key}" for name in SCHEMA["features"] for key in SCHEMA["statistics"]
    }


async def test_the_frames_are_the_recorded_states_with_task_and_subtask(
    dataset: Path, kitchen: Path, reading: Reading
) -> None:
    frames = pd.read_parquet(dataset / "data")
    # A sample may be recorded before the exact event of its state, which is the first that a moment has it from.
    with closing(sqlite3.connect(kitchen / "pycrorm.db")) as database:
        sampled = {*database.execute("SELECT episode, sequence FROM event WHERE type = 'StateSampled'")}
    info = json.loads((dataset / "meta/info.json").read_text())
    names = info["features"]["observation.state"]["names"]
    tasks, subtasks = (pd.read_parquet(dataset / f"meta/{name}.parquet") for name in ("tasks", "subtasks"))
    assert tasks.index.tolist() == ["fails", "succeeds"]
    for number, part in frames.groupby("episode_index"):
        assert part.frame_index.tolist() == [*range(len(part))]
        np.testing.assert_allclose(part.timestamp, part.frame_index / info["fps"], rtol=1e-6)
        states = np.stack(part["observation.state"].tolist())
        np.testing.assert_array_equal(np.stack(part.action.tolist())[:-1], states[1:])
        assert (np.diff(states, axis=0) != 0).any(axis=1).all()
        assert {*tasks.index[part.task_index]} == {("fails", "succeeds")[number]}
        exact = part[[(number + 1, each) not in sampled for each in part.event]]
        assert len(exact) > 5
        for _, frame in exact.iterrows():
            then = await reading.as_of(number + 1, sequence=frame.event)
            assert then.world.robot is not None
            robot = then.world.object(then.world.robot.name)
            state = dict(zip(names, frame["observation.state"], strict=True))
            assert [state["base.x"], state["base.y"]] == pytest.approx([robot.pose.position.x, robot.pose.position.y])
            assert {name: state[name] for name in robot.joints} == pytest.approx(dict(robot.joints), abs=1e-6)
            running = [each for each in then.running if each.kind == "action"]
            label = subtasks.index[frame.subtask_index]
            assert label.split(" ")[0] == (running[-1].dtype if running else "idle")
    assert "PickUpAction milk" in subtasks.index


async def test_it_is_written_without_pandas_and_has_the_index_that_pandas_reads(
    reading: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pa.array(np.zeros(1))  # pyarrow looks for pandas once, and takes the None below for a module
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        await export(reading, 1, tmp_path / "set", file_format="lerobot")
    for name in ("task", "subtask"):
        names = pd.read_parquet(tmp_path / f"set/meta/{name}s.parquet")
        assert (names.index.name, [*names.columns]) == (name, [f"{name}_index"])
        assert names[f"{name}_index"].tolist() == [*range(len(names))]


def test_the_plan_has_every_node_with_its_frames_and_failure(dataset: Path) -> None:
    plan = pd.read_parquet(dataset / "meta/plan.parquet")
    failed = plan[plan.reason.notna()]
    assert {*failed.episode_index} == {0}
    assert {*failed.status} == {"FAILED"}
    roots = plan[plan.kind == "root"]
    assert (roots.dataset_to_index - roots.dataset_from_index).sum() == len(pd.read_parquet(dataset / "data"))


def test_the_statistics_are_those_of_all_frames(dataset: Path) -> None:
    states = np.stack(pd.read_parquet(dataset / "data")["observation.state"].tolist()).astype(float)
    statistics = json.loads((dataset / "meta/stats.json").read_text())["observation.state"]
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(statistics[name], getattr(states, name)(axis=0), rtol=1e-5, atol=1e-7)
    assert statistics["count"] == [len(states)]


async def test_by_time_a_frame_holds_the_state_in_force(reading: Reading, tmp_path: Path) -> None:
    await export(reading, 1, tmp_path / "time", file_format="lerobot", clock="time", fps=200)
    frames = pd.read_parquet(tmp_path / "time/data")
    np.testing.assert_allclose(np.diff(frames.time_s), 1 / 200, atol=1e-6)
    assert frames.event.is_monotonic_increasing
    info = json.loads((tmp_path / "time/meta/info.json").read_text())
    assert info["fps"] == 200
    assert (await export_again(reading, tmp_path / "time.manifest.json")).same


async def test_by_time_a_frame_names_the_action_that_runs_while_the_robot_does_not_move(tmp_path: Path) -> None:
    script = Script()
    put = script.put
    put(EpisodeStarted("drive and talk", "me", "host", "1.0", "3.11"))  # 1
    root = put(NodeStarted("root"))  # 2
    robot = put(ObjectAdded("pr2", "ROBOT", pose()))  # 3: the first frame
    for x in (1, 2):
        drive = put(NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(x)}))  # 4, 11
        put(ObjectMoved(robot, "pr2", "ROBOT", pose(x), drive))  # 5, 12
        put(NodeEnded(drive, "SUCCEEDED"))  # 6, 13
        if x == 1:
            talk = put(NodeStarted("action", root, name_of(SAYING), {"text": "hi"}))  # 7
            put(ObjectAdded("cup", "CUP", pose()))  # 8
            put(NodeEnded(talk, "SUCCEEDED"))  # 9
            put(ObjectAdded("bowl", "BOWL", pose()))  # 10
    put(ObjectRemoved(ObjectReference(robot, robot)))  # 14
    put(NodeEnded(root, "SUCCEEDED"))
    put(EpisodeEnded("SUCCEEDED"))
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, [*declarations(NAVIGATE, SAYING), *script.records])
    async with Reading.open(url) as reading:
        await export(reading, 1, tmp_path / "set", file_format="lerobot", clock="time", fps=2)
    frames = pd.read_parquet(tmp_path / "set/data")
    subtasks = pd.read_parquet(tmp_path / "set/meta/subtasks.parquet").index
    assert frames.time_s.tolist() == [each / 2 for each in range(4, 25)]  # an event a second, the first one at 0
    assert frames.event.tolist() == [each // 2 for each in range(6, 27)]
    assert frames["observation.state"].str[0].tolist() == [0] * 4 + [1] * 14 + [2] * 3
    names = ["idle"] * 2 + ["NavigateAction"] * 4 + ["idle"] * 2 + ["SayingAction"] * 4 + ["idle"] * 4
    assert subtasks[frames.subtask_index].tolist() == [*names, *["NavigateAction"] * 4, "idle"]
    plan = pd.read_parquet(tmp_path / "set/meta/plan.parquet")
    ranges = plan.dataset_from_index.tolist(), plan.dataset_to_index.tolist()
    assert ranges == ([0, 2, 8, 16], [21, 6, 12, 20])


async def test_the_plan_says_that_nodes_are_lost_which_ran_when_the_process_died(tmp_path: Path) -> None:
    script = Script()
    put = script.put
    put(EpisodeStarted("dies", "me", "host", "1.0", "3.11"))
    root = put(NodeStarted("root"))
    robot = put(ObjectAdded("pr2", "ROBOT", pose()))
    put(ObjectMoved(robot, "pr2", "ROBOT", pose(1), root))
    put(EpisodeEnded("LOST"))
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, script.records)
    async with Reading.open(url) as reading:
        await export(reading, 1, tmp_path / "set", file_format="lerobot")
    assert pd.read_parquet(tmp_path / "set/meta/plan.parquet").status.tolist() == ["LOST"]


@pytest.mark.slow
async def test_images_show_the_scene_of_each_frame(reading: Reading, tmp_path: Path) -> None:
    await export(reading, 3, tmp_path / "seen", file_format="lerobot", images=(64, 48))
    info = json.loads((tmp_path / "seen/meta/info.json").read_text())
    name = "observation.images.scene"
    assert info["features"][name] == {"dtype": "image", "shape": [48, 64, 3], "names": ["height", "width", "channels"]}
    frames = parquet.read_table(tmp_path / "seen/data/chunk-000/file-000.parquet")
    assert str(frames.schema.field(name).type) == "struct<bytes: binary, path: string>"
    pictures = [matplotlib.image.imread(io.BytesIO(each["bytes"])) for each in frames.column(name).to_pylist()]
    assert {each.shape for each in pictures} == {(48, 64, 3)}
    assert not np.array_equal(pictures[0], pictures[-1])  # the robot is elsewhere
    statistics = json.loads((tmp_path / "seen/meta/stats.json").read_text())[name]
    means = np.mean(pictures, axis=(0, 1, 2)).reshape(3, 1, 1)
    np.testing.assert_allclose(statistics["mean"], means, atol=1e-3)
    assert statistics["count"] == [len(pictures)]
    assert (await export_again(reading, tmp_path / "seen.manifest.json")).same


async def test_a_data_set_is_replaced_only_when_asked_and_only_by_its_kind(dataset: Path, reading: Reading) -> None:
    with pytest.raises(CallerError, match="kitchen exists: add --force"):
        await export(reading, 1, dataset, file_format="lerobot")
    await export(reading, 1, dataset, file_format="lerobot", force=True)
    assert len(pd.read_parquet(dataset / "meta/tasks.parquet")) == 1
    other = dataset.with_name("other")
    other.mkdir()
    (other / "mine").touch()
    with pytest.raises(CallerError, match="is not such a data set"):
        await export(reading, 1, other, file_format="lerobot", force=True)
    assert (other / "mine").exists()


async def test_a_full_disk_leaves_no_data_set(reading: Reading, tmp_path: Path) -> None:
    with files_of_at_most(40_000), pytest.raises(OSError, match="File too large"):
        await export(reading, 1, tmp_path / "set", file_format="lerobot")  # the file of episodes is larger
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_completed_leaves_the_one_before(tmp_path: Path) -> None:
    target = tmp_path / "set"
    for before in ([], ["set", "mine"]):
        with pytest.raises(OSError, match="No space left"), new_folder(target, force=True, marker="mine") as written:
            (written / "part").touch()
            raise OSError(errno.ENOSPC, "No space left on device")
        assert [each.name for each in tmp_path.rglob("*")] == before
        target.mkdir(exist_ok=True)
        (target / "mine").touch()
    with new_folder(target, force=True, marker="mine") as written:
        (written / "new").touch()
    assert [each.name for each in tmp_path.rglob("*")] == ["set", "new"]


@pytest.mark.parametrize(
    ("what", "options", "message"),
    [
        ([1, 4], {}, "episode 4 has no robot"),
        (
            [1, 3],
            {},
            r"episode 3 has the robot courier with other joints than pr2 of episode 1 \(.* …\): export them into",
        ),
        (
            [3],
            {"clock": "time", "fps": 1},
            "episode 3 has 1 frame by time, and LeRobot needs two: give a higher --fps",
        ),
        ([1], {"clock": "sun"}, "clock must be 'event' or 'time', got 'sun'"),
        ([1], {"images": (0, 240)}, r"images must be 16 to 2000 pixels wide and high, got \(0, 240\)"),
        ([1], {"fps": 0}, "fps must be 1 to 1000, got 0"),
        ("root_failure", {}, "the format lerobot holds whole episodes, and root_failure is a view"),
        ([99], {}, "there is no episode '99'"),
    ],
)
async def test_what_the_format_cannot_hold_is_named_and_leaves_no_folder(
    reading: Reading, tmp_path: Path, what: Any, options: Any, message: str
) -> None:
    with pytest.raises(CallerError, match=message):
        await export(reading, what, tmp_path / "set", file_format="lerobot", **options)
    assert list(tmp_path.iterdir()) == []


async def test_options_of_lerobot_are_refused_for_rows(reading: Reading, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="clock and fps are options of the formats lerobot and mcap"):
        await export(reading, 1, tmp_path / "a.csv", fps=3)
    with pytest.raises(CallerError, match="images are an option of the format lerobot"):
        await export(reading, 1, tmp_path / "a.csv", images=(320, 240))


# --- images that were observed ---------------------------------------------------------------------------------

SIDE = 96, 64


def image(level: int, size: tuple[int, int] = SIDE) -> np.ndarray:
    """Return an image whose left half is grey of this level, and whose right half is blue."""
    width, height = size
    pixels = np.full((height, width, 3), level, np.uint8)
    pixels[:, width // 2 :] = (20, 40, 200)
    return pixels


def jpeg(pixels: np.ndarray) -> Blob:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=95)
    return Blob(file.getvalue(), "image/jpeg")


@pytest.fixture
async def filmed(tmp_path: Path) -> AsyncIterator[Reading]:
    """Yield a memory of two episodes in which a robot drives and looks, in the second without its wrist's camera.

    The head's camera observes between the moves 0, 1 and 1, 2 (twice), 3 (no image), 4 (of half the size); `small` is
    too narrow for a video.
    """
    url = f"sqlite:///{tmp_path / 'filmed.db'}"
    with Memory.sync(url) as memory:
        for number in (1, 2):
            with memory.recording.episode(description=f"film {number}") as episode:
                episode.object_added("robot", "agv", "ROBOT", Pose([0, 0, 0]))
                seen: dict[int, list[object]] = {
                    1: [Blob(png_of(image(100)), "image/png")],
                    2: [jpeg(image(130)), jpeg(image(160))],
                    3: [Blob(b"no image", "image/png")],
                    4: [Blob(png_of(image(220, (48, 32))), "image/png")],
                }
                for move in range(6):
                    for each in seen.get(move, ()):
                        episode.observe("head/camera", {"rgb": each})
                        episode.observe("small", image(90, (32, 24))[..., 0])
                        episode.observe("broken", Blob(b"no image", "image/png"))
                        episode.observe("depth", np.linspace(0.5, 2, 400, dtype=np.float32).reshape(20, 20))
                        if number == 1:
                            episode.observe("wrist", image(50))
                    episode.object_moved("robot", Pose([move + 1, 0, 0]))
        memory.flush()
    async with Reading.open(url) as reading:
        yield reading


HEAD = [0, 0, 100, 160, 160, 220, 220]  # the frames are those of the robot's addition and six moves
SMALL = [0, 0, *[90] * 5]


def videos_of(folder: Path, feature: str, episode: int) -> list[np.ndarray]:
    """Return the images that LeRobot's reader takes from a video for the frames of an episode."""
    import av

    info = json.loads((folder / "meta/info.json").read_text())
    [row] = parquet.read_table(folder / "meta/episodes", filters=[("episode_index", "=", episode)]).to_pylist()
    chunk, file, begin_s, end_s = (
        row[f"videos/{feature}/{name}"] for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    )
    path = folder / info["video_path"].format(video_key=feature, chunk_index=chunk, file_index=file)
    with av.open(str(path)) as container:
        [stream] = container.streams.video
        declared, rate = info["features"][feature]["info"], stream.base_rate
        assert (stream.codec.canonical_name, stream.pix_fmt, rate.numerator / rate.denominator) == (
            declared["video.codec"],
            declared["video.pix_fmt"],
            declared["video.fps"],
        )
        assert (stream.height, stream.width, 3) == tuple(info["features"][feature]["shape"])
        frames = {each.time: each.to_ndarray(format="rgb24") for each in container.decode(stream)}
    timestamps = pd.read_parquet(folder / "data").query(f"episode_index == {episode}").timestamp
    assert end_s - begin_s == pytest.approx(len(timestamps) / info["fps"])
    wanted = [begin_s + each for each in timestamps]
    times = np.array([*frames])
    nearest = [float(times[np.abs(times - each).argmin()]) for each in wanted]
    np.testing.assert_allclose(nearest, wanted, rtol=0, atol=1e-4)  # the tolerance of LeRobot's reader
    return [frames[at] for at in nearest]


def levels_of(pictures: list[np.ndarray]) -> list[float]:
    """Return the mean level of the left half of each image."""
    return [float(each[:, : each.shape[1] // 2].mean()) for each in pictures]


async def test_observed_images_are_videos_of_the_last_one_before_each_frame(
    filmed: Reading, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("av", reason="videos need PyAV")
    folder = tmp_path / "film"
    await export(filmed, ["1", "2"], folder, file_format="lerobot", fps=30)
    info = json.loads((folder / "meta/info.json").read_text())
    features = {name: each for name, each in info["features"].items() if name.startswith("observation.images.")}
    head, wrist, small = (f"observation.images.{each}" for each in ("head_camera.rgb", "wrist", "small"))
    assert {name: (each["dtype"], each["shape"]) for name, each in features.items()} == {
        head: ("video", [64, 96, 3]),
        wrist: ("video", [64, 96, 3]),
        small: ("image", [24, 32, 3]),
    }
    assert {str(each.relative_to(folder)) for each in folder.rglob("*.mp4")} == {
        f"videos/{each}/chunk-000/file-000.mp4" for each in (head, wrist)
    }
    for episode, at_wrist in ((0, [0, 0, *[50] * 5]), (1, [0] * 7)):
        decoded = videos_of(folder, head, episode)
        assert levels_of(decoded) == pytest.approx(HEAD, abs=3)
        assert levels_of(videos_of(folder, wrist, episode)) == pytest.approx(at_wrist, abs=3)
        difference = np.abs(decoded[3].astype(int) - image(160)).mean()
        assert difference < 3
    rows = pd.read_parquet(folder / "data")
    assert {name for name in rows if name.startswith("observation.images.")} == {small}
    pictures = [np.asarray(Image.open(io.BytesIO(each["bytes"]))) for each in rows[small]]
    assert levels_of(pictures) == SMALL * 2
    statistics = json.loads((folder / "meta/stats.json").read_text())
    expected = (sum(HEAD) + 5 * 20) / 14 / 255  # of red, in two halves of seven frames, of which two are black
    assert statistics[head]["mean"][0][0][0] == pytest.approx(expected, abs=0.002)
    assert statistics[head]["count"] == [14]
    head_note = (
        "camera head_camera.rgb: 6 of 10 images are in the 14 frames, each of which has the last one before it"
        " (--clock time takes frames at a rate); black frames before the first image: 4; images of other sizes, scaled"
        " to 96 x 64: 2; images that cannot be read: 2 (it is no PNG, JPEG, GIF or WebP image)"
    )
    small_note = (
        "small are PNGs in the rows, because videos have sides of 64 to 4096 pixels and at most 240 frames a second,"
        " and these 32 x 24 at 30"
    )
    assert head_note in caplog.text
    assert small_note in caplog.text
    broken_note = "camera broken is left out: no image of it can be read (it is no PNG, JPEG, GIF or WebP image)"
    assert broken_note in caplog.text
    assert (await export_again(filmed, folder.with_name("film.manifest.json"))).same


async def test_without_pyav_observed_images_are_png_in_the_rows(
    filmed: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "av.codec", None)
    monkeypatch.setitem(sys.modules, "av", None)
    await export(filmed, 1, tmp_path / "film", file_format="lerobot")
    assert "are PNGs in the rows, because videos need PyAV: pip install 'pycrorm-async[video]'" in caplog.text
    assert json.loads((tmp_path / "film/meta/info.json").read_text())["video_path"] is None
    rows = pd.read_parquet(tmp_path / "film/data")
    pictures = [Image.open(io.BytesIO(each["bytes"])) for each in rows["observation.images.head_camera.rgb"]]
    assert {(each.format, each.size) for each in pictures} == {("PNG", SIDE)}
    assert levels_of([np.asarray(each) for each in pictures]) == pytest.approx(HEAD, abs=3)
    assert not [*tmp_path.rglob("*.mp4")]
    monkeypatch.undo()
    await export(filmed, 1, tmp_path / "fast", file_format="lerobot", fps=241)  # of which the encoder would fail
    assert not [*tmp_path.rglob("*.mp4")]
    await export(filmed, 1, tmp_path / "states", file_format="lerobot", images="none")
    assert not [each for each in pd.read_parquet(tmp_path / "states/data") if "images" in each]


async def test_a_disk_that_is_full_while_a_video_is_written_leaves_no_data_set(
    filmed: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("av", reason="videos need PyAV")
    close = Camera.close

    def close_on_a_small_disk(camera: Camera) -> None:  # only here, because SQLite needs space to read
        with files_of_at_most(700):
            close(camera)

    monkeypatch.setattr(Camera, "close", close_on_a_small_disk)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(OSError, match="File too large"):
        await export(filmed, 1, tmp_path / "film", file_format="lerobot")
    assert sorted(tmp_path.iterdir()) == before


def test_lerobots_own_loader_reads_it(dataset: Path) -> None:
    pytest.importorskip("lerobot", reason="LeRobot brings torch, 6 GB: tests/README.md has the commands")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    loaded = LeRobotDataset("local/kitchen", root=dataset, delta_timestamps={"action": [0.0, 0.1]})
    frames = pd.read_parquet(dataset / "data")
    assert (loaded.num_episodes, loaded.num_frames) == (2, len(frames))
    subtasks = pd.read_parquet(dataset / "meta/subtasks.parquet").index
    for index in (0, len(frames) - 1):
        item = loaded[index]
        assert item["observation.state"].tolist() == frames["observation.state"][index].tolist()
        assert (item["task"], item["action"].shape[0]) == (("fails", "succeeds")[index > 0], 2)
        assert item.get("subtask", subtasks[frames.subtask_index[index]]) == subtasks[frames.subtask_index[index]]
