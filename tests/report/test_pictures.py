"""What was observed is seen on the page: pictures on the time axis and beside the scene, points in it, faults named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pycrorm_async.events.types import Blob
from pycrorm_async.memory import Memory
from pycrorm_async.query import observed_images
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.document import episode_document
from pycrorm_async.report.pictures import Images
from pycrorm_async.world import Pose
from tests.report.browser import Browser
from tests.report.conftest import page_of

HOSTILE = '"><img src=x onerror=alert(1)>'


def picture(number: int, side: int = 64) -> bytes:
    """Return a PNG of noise, which cannot be made much smaller without loss."""
    return png_of(np.random.default_rng(number).integers(0, 255, (side, side, 3), np.uint8))


def observe(url: str, count: int, side: int = 64, *, world: bool = True) -> None:
    with Memory.sync(url) as memory:
        with memory.recording.episode(description="what it saw") as episode:
            if world:
                episode.object_added("robot", "agv", "ROBOT", Pose([0, 0, 0]))
            for number in range(count):
                episode.observe(HOSTILE, {"rgb": Blob(picture(number, side), "image/png"), "count": number})
            depth = np.linspace(0.5, 2, 120 * 160, dtype=np.float32).reshape(120, 160)
            episode.observe("depth", depth)
            episode.observe("lidar", np.random.default_rng(0).random((9_000, 3)).astype(np.float32))
            episode.observe("fake", Blob(b"<svg onload=alert(1)>", "image/png"))
            episode.observe("broken", Blob(picture(0)[:8] + b"nothing", "image/png"))
            episode.observe("torn", Blob(picture(0)[:100], "image/png"))
            episode.observe("sound", Blob(b"1234", "audio/wav"))
            episode.observe("no array", np.full((90, 90), np.nan))
        memory.flush()


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path / 'memory.db'}"


async def document_of(url: str, images: Images) -> dict[str, Any]:
    async with Reading.open(url) as reading:
        return await episode_document(reading, "last", images=images)


async def test_a_document_has_pictures_once_and_the_reasons_of_those_that_are_none(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("PIL")
    observe(url, 2)
    document = await document_of(url, "thumbs")
    pictures = {each["camera"]: each for each in document["pictures"]}
    kinds = {camera: (each["kind"], each.get("text"), each.get("fault")) for camera, each in pictures.items()}
    assert kinds == {
        f"{HOSTILE} rgb": ("image", "", None),
        "depth": ("depth", "0.5 to 2", None),
        "lidar": ("points", "9,000 points", None),
        "fake": ("image", None, "it is no PNG, JPEG, GIF or WebP image"),
        "torn": ("image", "whole", None),  # a browser says what it shows of a small one
        "broken": ("image", "whole", None),
        "no array": ("depth", None, "it has no finite number"),
    }
    assert document["contents"][0].startswith("data:image/jpeg;base64,")
    assert document["unpictured"] == 0
    assert (await document_of(url, "none"))["contents"] == []
    assert (await document_of(url, "none"))["unpictured"] == 8
    whole = await document_of(url, "full")
    assert [each.get("text") for each in whole["pictures"]][:3] == ["whole", "whole", "whole, 0.5 to 2"]
    assert whole["contents"][0].startswith("data:image/png;base64,")
    monkeypatch.setattr(observed_images, "_CONTENT_MAX", 999)
    faults = [each.get("fault") for each in (await document_of(url, "thumbs"))["pictures"]]
    assert faults.count("it has 108,128 bytes, more than 999") == 1


@pytest.mark.slow
async def test_ten_thousand_images_make_a_page_of_200_and_of_every_camera_its_share(url: str) -> None:
    content = {name: picture(number) for number, name in enumerate(("left", "right"))}
    with Memory.sync(url) as memory:
        with memory.recording.episode(description="a drive") as episode:
            for _ in range(5_000):
                for name, each in content.items():
                    episode.observe(name, Blob(each, "image/png"))
        memory.flush()
    document = await document_of(url, "thumbs")
    cameras = [each["camera"] for each in document["pictures"]]
    assert (cameras.count("left"), cameras.count("right"), document["unpictured"]) == (100, 100, 9_800)
    assert len(document["contents"]) == 2
    assert max(each["at"] for each in document["pictures"]) == document["observations"][-1]["at"]


@pytest.mark.slow
async def test_a_page_with_200_thumbnails_has_less_than_8_megabytes(url: str, tmp_path: Path) -> None:
    pytest.importorskip("PIL")
    observe(url, 200, 320)
    written = await page_of(url, tmp_path / "page.html")
    assert written.path.stat().st_size < 8_000_000
    full = await page_of(url, tmp_path / "full.html", images="full")
    assert written.path.stat().st_size < full.path.stat().st_size < 40_000_000


SHOWN = "[...document.querySelectorAll('#seen figcaption')].map((each) => each.textContent)"


@pytest.mark.slow
async def test_the_page_shows_the_picture_of_the_moment_on_the_axis_beside_the_scene_and_in_full(
    url: str, tmp_path: Path, chrome: Browser
) -> None:
    observe(url, 12)
    await page_of(url, tmp_path / "page.html")
    with chrome.open(tmp_path / "page.html") as tab:
        tab.settle()
        assert f"{HOSTILE} rgb" in tab.ask(SHOWN)
        assert "depth 0.5 to 2" in tab.ask(SHOWN)
        assert "it is no PNG" in tab.ask("document.getElementById('seen').textContent")
        tab.wait_for("document.getElementById('seen').textContent.includes('not readable')")
        assert tab.ask("pycrormPage.view.clouds.children[0].geometry.attributes.position.count") == 4_500
        first = tab.ask("pycrormPage.episode.cameras.values().next().value[2].at")
        tab.ask(f"pycrormPage.seek({first})")
        assert tab.ask(SHOWN) == [f"{HOSTILE} rgb"]
        assert tab.ask("pycrormPage.view.clouds.children.length") == 0
        source = f"pycrormPage.episode.cameras.values().next().value.find((each) => each.at === {first}).source"
        assert tab.ask(f"document.querySelector('#seen img').src === {source}")
        assert tab.ask("document.querySelectorAll('.seen-row .lit').length") == 1
        tab.ask("document.querySelector('#seen button').click()")
        assert tab.ask("document.getElementById('picture').open")
        tab.press("ArrowRight")
        assert tab.ask("pycrormPage.event") > first
        tab.press("Escape")
        assert not tab.ask("document.getElementById('picture').open")
        tab.ask("document.querySelector('.pictures').click()")
        assert tab.ask("getComputedStyle(document.getElementById('seen')).display") == "none"
        assert tab.problems() == []
        assert tab.requests() == [(tmp_path / "page.html").as_uri()]


@pytest.mark.slow
async def test_without_a_world_the_pictures_are_shown_alone(url: str, tmp_path: Path, chrome: Browser) -> None:
    observe(url, 3, world=False)
    await page_of(url, tmp_path / "page.html", images="full")
    with chrome.open(tmp_path / "page.html", width=390) as tab:
        tab.settle()
        assert tab.ask("document.querySelector('#seen img').getBoundingClientRect().height") > 60
        assert tab.ask("document.documentElement.scrollWidth") <= 390
        assert tab.problems() == []
