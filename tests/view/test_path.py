"""The camera path in a browser: keyframes, playback, file, film (`docs/viewer.md`)."""

import json
from pathlib import Path

import av
import numpy as np
import pytest

from tests.view.steps import MIDDLE, START, Steps

pytestmark = pytest.mark.slow

SECOND = START.replace("p=0,-3,0", "p=1,-3,0")
ROWS = "[...document.querySelectorAll('#keyframes .name')].map((e) => e.textContent).join()"
TOTAL = "document.getElementById('seconds').value"
FITS = (
    "[...document.querySelectorAll('#aside button, #aside select, #aside input')].filter((e) => e.offsetParent)"
    ".every((e) => { const r = e.getBoundingClientRect(), a = document.getElementById('aside').getBoundingClientRect();"
    " return r.height >= SIZE && r.left >= a.left && r.right <= a.right && a.right <= innerWidth"
    " && a.bottom <= innerHeight; })"
)


def there(link: str) -> list[object]:
    return ["ask", f"location.hash = '{link}'"]


def test_keyframes_and_the_file_of_a_path(bundle: Path, tmp_path: Path) -> None:
    page = Steps()
    page.do(["key", "n"])
    alone = page.ask("document.getElementById('play').disabled")
    page.do(["click", "#add-keyframe"], there(SECOND), ["settle"], ["key", "k"], ["key", "k"])
    rows = page.ask(ROWS)
    page.do(["click", "#keyframes [aria-label='Remove keyframe 2']"])
    removed, before = page.ask(ROWS), page.view()
    page.do(["fill", "#keyframes input", "4"])
    longer, unmoved = page.ask(TOTAL), page.view()
    page.do(["fill", "#seconds", "1"])
    segment = page.ask("document.querySelector('#keyframes input').value")
    page.do(["click", "#keyframes .name"])
    back = page.view()
    page.do(["save", "#save-path", tmp_path / "screen.json"], ["select", "#path-size", "1280x720"])
    named = len(page.steps) - 2
    page.do(["click", "#loop"], ["click", "#smooth"], ["save", "#save-path", tmp_path / "hd.json"])
    looped = page.ask(TOTAL)
    page.do(["key", "n"])
    closed = page.ask("document.getElementById('aside').hidden")
    page.run(bundle, START, viewport=(901, 500))

    assert page[alone] and page[rows] == "Keyframe 1,Keyframe 2,Keyframe 3" and page[removed] == "Keyframe 1,Keyframe 2"
    assert page[longer] == "4" and page[segment] == "1" and page[before] == page[unmoved]  # typing does not move it
    assert np.allclose(page.seen(back).position, [0, -3, 0], atol=1e-6) and page[looped] == "1.5" and page[closed]
    screen, hd = (json.loads((tmp_path / name).read_text()) for name in ("screen.json", "hd.json"))
    assert page[named] == "camera_path.json"
    assert (screen["render_width"], screen["render_height"]) == (900, 500)  # even, as required for films
    assert (hd["render_width"], hd["render_height"], hd["is_cycle"], hd["smoothness_value"]) == (1280, 720, True, 1)
    assert len(screen["camera_path"]) == 30 and len(hd["camera_path"]) == 45
    poses = [np.array(frame["camera_to_world"]).reshape(4, 4) for frame in screen["camera_path"]]
    # looks along y, z up: OpenGL axes
    want = np.array([[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]])
    assert np.allclose(poses[0], want) and np.allclose(poses[-1][:3, 3], [1, -3, 0])
    assert screen["camera_path"][0]["fov"] == pytest.approx(2 * np.degrees(np.arctan(0.5)))


def test_a_saved_path_is_opened_again(bundle: Path, tmp_path: Path) -> None:
    page = Steps()
    page.do(["press", "#add-keyframe"], there(SECOND), ["settle"], ["press", "#add-keyframe"], ["key", "k"])
    page.do(["press", "#loop"], ["press", "#smooth"], ["key", "n"])
    page.do(["fill", "#seconds", "3"], ["save", "#save-path", tmp_path / "a.json"])
    for _ in range(3):
        page.do(["press", "#keyframes [title=Remove]"])
    page.do(["press", "#loop"], ["press", "#smooth"], ["upload", "#path-file", tmp_path / "a.json"])
    page.do(["until", "document.querySelectorAll('#keyframes li').length === 3"])
    total = page.ask(TOTAL)
    pressed = page.ask("['loop', 'smooth'].map((id) => document.getElementById(id).ariaPressed).join()")
    page.do(["save", "#save-path", tmp_path / "b.json"], ["press", "#keyframes .name"])
    first = page.view()
    page.do(["upload", "#path-file", bundle / "cameras.json"])
    page.do(["until", "document.getElementById('notice').textContent.includes('cameras.json is no camera path')"])
    kept = page.ask(ROWS)
    page.run(bundle, START)

    assert page[total] == "3" and page[pressed] == "true,false" and page[kept].count("Keyframe") == 3
    assert np.allclose(page.seen(first).position, [0, -3, 0], atol=1e-6)
    assert json.loads((tmp_path / "a.json").read_text()) == json.loads((tmp_path / "b.json").read_text())


def test_a_path_plays_until_the_reader_moves(bundle: Path) -> None:
    page = Steps()
    name = "document.getElementById('play').textContent"
    page.do(["press", "#add-keyframe"], there(SECOND), ["settle"], ["press", "#add-keyframe"], ["key", "v"])
    during = page.ask(name)
    page.do(["until", f"{name} === 'Play'"], ["settle"])
    end = page.view()
    page.do(["press", "#loop"], ["key", "v"], ["wheel", MIDDLE, -100])
    stopped = page.ask(name)
    page.do(["settle"])
    moved = page.view()
    page.do(["key", "v"], ["key", "h"])
    home = page.ask(name)
    page.run(bundle, START)

    assert (page[during], page[stopped], page[home]) == ("Stop", "Play", "Play")
    assert np.allclose(page.seen(end).position, [1, -3, 0], atol=1e-6)
    assert page.seen(moved).position[1] != pytest.approx(-3, abs=1e-6)


def test_a_film_has_the_size_and_time_of_what_is_shown(bundle: Path, tmp_path: Path) -> None:
    page = Steps()
    page.do(["press", "#add-keyframe"], there(SECOND), ["settle"], ["press", "#add-keyframe"])
    page.do(["save", "#record", tmp_path / "film.webm"])
    named = len(page.steps) - 1
    page.run(bundle, START, drawn=True, viewport=(320, 200))

    assert page[named] == f"{bundle.name}.webm"
    with av.open(str(tmp_path / "film.webm")) as film:
        frames = [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in film.decode(video=0)]
    print(f"{len(frames)} frames in {frames[-1][0] - frames[0][0]:.2f} s")
    assert {image.shape for _, image in frames} == {(50, 80, 3)} and len(frames) >= 3
    assert 1.5 < frames[-1][0] - frames[0][0] < 4
    first, last = (image.astype(float) for image in (frames[0][1], frames[-1][1]))
    assert np.abs(first - last).mean() > 2
