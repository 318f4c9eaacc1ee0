"""Suites, plans and the command line of a matrix."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest

from bitymi_ns import cli
from bitymi_ns.measure.bench.matrix import PlanName, local_scenes, read_plan, standard_scenes, suites
from bitymi_ns.measure.bench.process import BenchError
from bitymi_ns.presets import preset_names


def make_suite(root: Path, name: str) -> Path:
    """Make the folders of a standard dataset."""
    for scene, factor in suites()[name]["scenes"].items():
        for part in suites()[name]["needed"]:
            (root / scene / part.format(images=f"images_{factor}" if factor > 1 else "images")).mkdir(parents=True)
    return root


def test_standard_suites_are_the_published_ones(tmp_path: Path) -> None:
    found = suites()
    counts = {"mipnerf360": 9, "tanksandtemples": 2, "nerf-synthetic": 8}
    assert {name: len(suite["scenes"]) for name, suite in found.items()} == counts
    factors = found["mipnerf360"]["scenes"]
    assert {s for s, factor in factors.items() if factor == 2} == {"bonsai", "counter", "kitchen", "room"}
    assert {s for s, factor in factors.items() if factor == 4} == {"bicycle", "flowers", "garden", "stump", "treehill"}
    bicycle, room = standard_scenes("mipnerf360", make_suite(tmp_path / "a", "mipnerf360"), ["bicycle", "room"])
    parser = " ".join(bicycle.parser)
    assert parser.startswith("colmap --images-path images --colmap-path sparse/0 --downscale-factor 4")
    assert "--eval-mode interval --eval-interval 8" in parser and "--downscale-rounding-mode round" in parser
    assert "--downscale-factor 2" in " ".join(room.parser) and room.suite == "mipnerf360"
    train, truck = standard_scenes("tanksandtemples", make_suite(tmp_path / "b", "tanksandtemples"))
    assert "--downscale-factor 1" in " ".join(train.parser) and truck.scene == "truck"
    scenes = standard_scenes("nerf-synthetic", make_suite(tmp_path / "c", "nerf-synthetic"))
    assert len(scenes) == 8 and scenes[0].parser == ("blender-data",)


def test_local_captures(capture: Callable[[str], Path], tmp_path: Path) -> None:
    lego = tmp_path / "lego"
    lego.mkdir()
    (lego / "transforms_train.json").write_text("{}")
    (lego / "hull_pc.ply").write_text("")
    first, second = local_scenes([capture("fox"), lego])
    assert first.parser == ()
    assert second.parser == ("blender-data", "--ply-path", "hull_pc.ply")
    with pytest.raises(BenchError, match="different names"):
        local_scenes([lego, lego])
    with pytest.raises(BenchError, match="give --data"):
        local_scenes([])


@pytest.mark.parametrize("name", get_args(PlanName))
def test_plans_name_methods_that_there_are(name: PlanName) -> None:
    rows, bundles = read_plan(name)
    counts = {"ablation": (10, 0), "overdraw": (6, 1), "resolution": (4, 0), "atlas": (1, 14), "rate": (1, 4)}
    assert (len(rows), len(bundles)) == counts[name]
    assert {row.method for row in rows.values()} <= set(preset_names())
    assert all(options[0] == "--format" for options in bundles.values())


def run(*words: object) -> int:
    return cli.main(["bench", *map(str, words)])


def test_the_command_prints_the_tables_and_skips_what_is_done(
    fakes, capture: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["local", "--data", capture("fox"), "--steps", 10, "--formats", "uint8", "bc7", "--extra=--a.b 1"]
    words += ["--work", tmp_path / "w", "--output", tmp_path / "table.md"]
    fakes.fail("--format uint8")
    assert run(*words) == 1
    captured = capsys.readouterr()
    assert "| bitymi, bc7 | 20.99 | 0.800 | 0.100 |" in captured.out and "−0.010 |" in captured.out
    assert "- Failed: fox, bitymi: export (uint8) failed" in captured.out and "status 3" in captured.err
    assert (tmp_path / "table.md").read_text() in captured.out and "--a.b 1" in fakes.calls()[0]
    fakes.fail()
    assert run(*words) == 0
    assert len(fakes.calls()) == 2 and "4 of 6 cells are finished" in capsys.readouterr().err


def test_a_plan_gives_methods_options_and_bundles(fakes, capture: Callable[[str], Path], tmp_path: Path) -> None:
    words = ["local", "--data", capture("fox"), "--steps", 10, "--plan", "overdraw", "--extra=--a.b 1"]
    assert run(*words, "--work", tmp_path / "w") == 0
    calls = fakes.calls()
    trained, exported = ([call for call in calls if call.startswith(name)] for name in ("ns-train", "ns-export"))
    assert len(trained) == len(exported) == 6 and all("--a.b 1" in call for call in trained)
    assert sum("overdraw-weight 0.006 " in call for call in trained) == 1
    assert sum(call.startswith("ns-train bitymi-fast") for call in trained) == 2
    assert all("--format bc7" in call for call in exported)


def test_ctrl_c_says_how_to_go_on(
    fakes, capture: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bitymi_ns.measure.bench.engine.run_measured", interrupted)
    assert run("local", "--data", capture("fox"), "--steps", 10, "--work", tmp_path / "w") == 130
    assert "interrupted; no cell was finished. Run the same command to continue" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("local", "--data", "/nowhere"), "is not a capture"),
        (("mipnerf360", "--data", "/nowhere"), "not Mip-NeRF 360's bicycle: there is no images_4 and no sparse/0"),
        (("mipnerf360", "--data", "/nowhere", "--scenes", "fox"), "has no scene fox; it has bicycle"),
        (("mipnerf360", "--data", "/a", "/b"), "--data is one folder"),
        (("local", "--data", "/a", "--scenes", "x"), "--scenes chooses"),
        (("local", "--data", "/a", "--steps", "0"), "--steps must be"),
    ],
)
def test_mistakes_are_a_line(words: tuple[str, ...], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*words) == 1
    error = capsys.readouterr().err
    assert reason in error and error.startswith("bitymi: ") and error.count("\n") == 1
