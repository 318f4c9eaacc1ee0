"""Stubs of nerfstudio's console scripts, which write what the real ones would and keep a log."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bitymi_ns.measure.bench.matrix import Chain, Row, Scene, chains
from tests.bake.conftest import make_surfels
from tests.bundle.made import make

FAKE = """
import json, os, pathlib, sys, time

def given(name):
    return sys.argv[sys.argv.index(name) + 1]

def named(file):
    lines = (here / file).read_text().splitlines()
    return any(line and all(word in call for word in line.split()) for line in lines)

here, name = pathlib.Path(sys.argv[0]).parent, pathlib.Path(sys.argv[0]).name
call = " ".join([name, *sys.argv[1:]])
with open(here / "log", "a") as log:
    log.write(call + "\\n")
if named("fail"):
    print("something is wrong with the capture")
    sys.exit(3)
while named("slow"):
    time.sleep(0.05)
print(os.environ["OMP_WAIT_POLICY"])
if name == "ns-train":
    run = pathlib.Path(given("--output-dir"), given("--experiment-name"), sys.argv[1], given("--timestamp"))
    run.mkdir(parents=True)
    (run / "config.yml").write_text("config")
    steps = int(given("--max-num-iterations"))
    points = [dict(step=s, seconds=s / 10, cpu_seconds=s / 5, surfels=100 + s, psnr=20 + s / steps, fragments=7.0,
                   experiment_name=given("--experiment-name"), method_name=sys.argv[1]) for s in (steps // 2, steps)]
    (run / "training_curve.jsonl").write_text("".join(json.dumps(p) + "\\n" for p in points))
elif name == "ns-export":
    bundle = pathlib.Path(given("--output-dir"))
    bundle.mkdir(parents=True)
    (bundle / "bundle.json").write_text((here / "bundles" / given("--format") / "bundle.json").read_text())
    (bundle / "config.yml").write_text("config")
elif name == "ns-eval":
    assert pathlib.Path(given("--load-config")).is_file()
    baked = "/bundles/" in given("--load-config")
    results = dict(psnr=21.0 - 0.01 * baked, ssim=0.8, flip=0.1, lpips=float("nan"), surfels=120.0,
                   render_ms=9.0 - 5 * baked, fragments_per_pixel=8.0)
    pathlib.Path(given("--output-path")).write_text(json.dumps(dict(results=results)))
    pathlib.Path(given("--render-output-path")).mkdir(exist_ok=True)
"""


class Fakes:
    """The stubs: calls so far, calls that fail, and calls that block (`slow`) until no longer named."""

    def __init__(self, folder: Path, bundles: Path) -> None:
        self.folder = folder
        self.log, self.plan, self.slow = files = [folder / name for name in ("log", "fail", "slow")]
        for file in files:
            file.write_text("")
        (folder / "bundles").symlink_to(bundles)
        for name in ("ns-train", "ns-export", "ns-eval"):
            (folder / name).write_text(f"#!{sys.executable} -SE{FAKE}")
            (folder / name).chmod(0o755)

    def calls(self) -> list[str]:
        """Return and clear the command lines so far."""
        lines = self.log.read_text().splitlines()
        self.log.write_text("")
        return lines

    def fail(self, *lines: str) -> None:
        """Make calls with all words of one of the lines exit with status 3."""
        self.plan.write_text("\n".join(lines))


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of bundles, named by their formats."""
    folder = tmp_path_factory.mktemp("bundles")
    for form in ("bc7", "uint8"):
        make(make_surfels, folder / form, format=form)
    return folder


@pytest.fixture
def fakes(bundles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fakes:
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setattr("bitymi_ns.measure.bench.engine.tool", lambda name: str(folder / name))
    return Fakes(folder, bundles)


@pytest.fixture
def work(tmp_path: Path) -> Path:
    return tmp_path / "work"


@pytest.fixture
def capture(tmp_path: Path) -> Callable[[str], Path]:
    def make(name: str) -> Path:
        folder = tmp_path / "captures" / name
        folder.mkdir(parents=True)
        (folder / "transforms.json").write_text(json.dumps({"frames": []}))
        return folder

    return make


@pytest.fixture
def matrix(capture: Callable[[str], Path]) -> list[Chain]:
    """Two captures, two seeds, one format: 16 cells."""
    scenes = [Scene(name, str(capture(name))) for name in ("fox", "lego")]
    return chains(scenes, {"bitymi": Row("bitymi")}, {"bc7": ("--format", "bc7")}, (0, 1), 100)
