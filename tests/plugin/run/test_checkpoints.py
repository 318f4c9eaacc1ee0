"""Unusable checkpoints are refused with the file's name and a remedy."""

import dataclasses
import errno
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import checkpoints
from bitymi_ns.plugin.run.checkpoint_reader import _STORAGES, read_archive
from bitymi_ns.plugin.run.checkpoint_schema import Entry, Misfit, restore_optimizer
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField, TexelField
from bitymi_ns.train.exposure import Exposure
from bitymi_ns.train.optimizers import adam
from bitymi_ns.train.strategy import STATISTICS
from tests.e2e.runs import different
from tests.hostile import HOSTILE
from tests.typed import Patch, Printed


def state(scene: SceneConfig, rows: int = 5, step: int = 7) -> dict[str, Any]:
    torch.manual_seed(0)
    kind = VIEW_COLORS[scene.view_color]
    geometry = {"means": (3,), "quats": (4,), "log_scales": (2,), "opacity_logits": (), "beta_raw": ()}
    surfels = {name: torch.ones(rows, *row) for name, row in geometry.items()}
    surfels |= kind.first_values(torch.rand(rows, 3), scene, torch.Generator())
    pipeline: dict[str, Any] = {f"_model.scene.surfels.{name}": value for name, value in surfels.items()}
    if scene.texture == "hash":
        field = HashField(scene, (0.0, 0.0, 0.0), 1.0, True, 4)
    else:
        size = torch.tensor([[2, 3]] + [[0, 0]] * (rows - 1))[:rows]
        field = TexelField(size, torch.ones(rows), torch.zeros(6, 3), torch.ones(6), torch.ones(6))
    pipeline |= {f"_model.scene.field.{name}": value for name, value in field.state_dict().items()}
    pipeline["_model.device_indicator_param"] = torch.empty(0)
    exposure = Exposure("affine", [math.nan] * 3)
    exposure.table, exposure._moments = torch.zeros(3, 12), torch.zeros(2, 3, 12)
    run = {
        "strategy": {name: torch.zeros(rows) for name in STATISTICS} | {"generator": torch.Generator().get_state()},
        "guard": {"factor": 1.0, "rollbacks": 0, "limit": math.nan, "sum": 0.0, "count": 0},
        "step_sizes": {"footprints": torch.ones(rows)},
        "poses": {"motions": torch.zeros(3, 6).double()},
        "exposure": exposure.state_dict() | {"decided": True, "finding": "as asked for"},
        "seconds": 1.0,
        "cpu_seconds": 1.0,
        "random": torch.get_rng_state(),
        "capture": {"views": 3, "names": "a", "poses": "b"},
    }
    extra = {"version": 2, "scene": json.dumps(dataclasses.asdict(scene)), "near": 0.02, "train": "{}"}
    pipeline["_model._extra_state"] = {**extra, "trained_for": 60, "run": run}
    return {
        "step": step, "pipeline": pipeline, "schedulers": {}, "scalers": {},
        "optimizers": {name: moved(value).state_dict() for name, value in surfels.items()},
    }  # fmt: skip


def moved(value: torch.Tensor) -> torch.optim.Optimizer:
    parameter = torch.nn.Parameter(value.clone())
    optimizer = adam([parameter])
    parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    return optimizer


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = checkpoints.path_of(tmp_path, 7)
    torch.save(state(SceneConfig()), path)
    return path


def refused(path: Path, message: str, scene: SceneConfig | None = None) -> None:
    with pytest.raises(InputError, match=message) as stop:
        checkpoints.load(path, scene or SceneConfig())
    assert str(path) in str(stop.value)


def test_a_whole_checkpoint_loads(saved: Path) -> None:
    assert checkpoints.load(saved, SceneConfig())["step"] == 7
    assert checkpoints.newest_step(saved.parent) == 7
    other = SceneConfig(near=0.1, weight_bound=0.0, rim=1e-2, texture_moves_surfels=True)  # without effect on shapes
    assert checkpoints.load(saved, other)["step"] == 7
    refused(saved, "another preset:\n  --pipeline.model.scene.view-color: sv there, sh here", SceneConfig("sh"))


@pytest.mark.parametrize(
    "entry, same, recorded, message",
    [
        ("scene", {"prefilter": "low_pass"}, {"prefilter": "pixel"}, "scene.prefilter pixel, which is gone: train"),
        ("train", {"lr": {"means": None}}, {"lr": {"means": [1e-4]}}, "train.lr.means .* which is gone: train"),
    ],
)
def test_recorded_options_that_are_gone(saved: Path, entry: str, same: dict, recorded: dict, message: str) -> None:
    whole = state(SceneConfig())
    extra = whole["pipeline"]["_model._extra_state"]
    extra[entry] = json.dumps({**json.loads(extra[entry]), **same})
    torch.save(whole, saved)
    checkpoints.load(saved, SceneConfig())
    extra[entry] = json.dumps({**json.loads(extra[entry]), **recorded})
    torch.save(whole, saved)
    refused(saved, message)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated(saved: Path, share: float) -> None:
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    refused(saved, "damaged.*Copy it again")


def test_every_altered_byte_of_a_tensor_is_noticed(saved: Path) -> None:
    whole = bytearray(saved.read_bytes())
    ones = torch.ones(5, 4).numpy().tobytes()
    at = whole.index(ones) + 2
    whole[at] ^= 1  # another valid number
    saved.write_bytes(whole)
    refused(saved, "Bad CRC-32 for file .*damaged")
    earlier = checkpoints.path_of(saved.parent, 3)
    earlier.write_bytes(bytes(whole))
    refused(saved, f"Remove it to go back to {earlier.name}")


@pytest.mark.parametrize(
    ("error", "detail"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full: free some space"),
        (OSError(errno.EROFS, "Read-only file system"), "the file system is read-only"),
        (RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 9 vs 8"), "took only a part of it"),
    ],
)
@pytest.mark.parametrize("earlier", [True, False])
def test_a_full_disk(saved: Path, monkeypatch: Patch, error: Exception, detail: str, earlier: bool) -> None:
    def full(state: Any, file: Any) -> None:
        file.write(b"half")
        raise error

    monkeypatch.setattr(torch, "save", full)
    whole = saved.read_bytes()
    if not earlier:
        saved.unlink()
    then = "Resume with --load-dir .*intact" if earlier else "Train again"
    with pytest.raises(InputError, match=f"(?s)could not be written: .*{detail}.*{then}"):
        checkpoints.save(state(SceneConfig()), checkpoints.path_of(saved.parent, 9), saved.parent, SceneConfig())
    assert [p.name for p in saved.parent.iterdir()] == ([saved.name] if earlier else [])
    assert not earlier or saved.read_bytes() == whole


def test_the_folder_above_or_a_folder_for_a_file(saved: Path) -> None:
    run = saved.parent / "run"
    (run / "nerfstudio_models").mkdir(parents=True)
    saved.rename(run / "nerfstudio_models" / saved.name)
    with pytest.raises(InputError, match="they are in .*nerfstudio_models: --load-dir .*/run/nerfstudio_models"):
        checkpoints.newest_step(run)
    with pytest.raises(InputError, match=r"is a folder: give one of the files step-\*.ckpt with --load-checkpoint"):
        checkpoints.load(saved.parent, SceneConfig())


def test_altered_contents(saved: Path) -> None:
    newer = state(SceneConfig())["pipeline"]
    newer["_model._extra_state"]["version"] = checkpoints.STATE_VERSION + 1
    for change, message in (
        ({"pipeline": state(SceneConfig(), rows=0)["pipeline"]}, "holds no surfels"),
        ({"pipeline": {"_model.gauss_params.means": torch.zeros(3, 3)}}, "not a checkpoint of this method"),
        ({"pipeline": newer}, "newer bitymi-ns; update"),
    ):
        torch.save(state(SceneConfig()) | change, saved)
        refused(saved, message)
    torch.save([1, 2], saved)
    refused(saved, "not a nerfstudio checkpoint")
    for scene in ("{", "[1]", "3"):
        altered = state(SceneConfig())
        altered["pipeline"]["_model._extra_state"]["scene"] = scene
        torch.save(altered, saved)
        refused(saved, "was altered: it does not describe its scene")


MEANS, SIZE, EXTRA = "_model.scene.surfels.means", "_model.scene.field.size", "_model._extra_state"


def at(*keys: object) -> Callable[[dict[str, Any], Any], None]:
    def replace(whole: dict[str, Any], value: Any) -> None:
        for key in keys[:-1]:
            whole = whole[key]
        whole[keys[-1]] = value

    return replace


RUN = ("pipeline", EXTRA, "run")
WRONG = [
    (("step",), "seven", "step has to be a whole number, not str"),
    (("step",), True, "step has to be a number"),
    (("step",), 10**400, "step has to be from 0 to 1e"),
    (("pipeline",), [1, 2], "not a checkpoint of this method"),
    (("optimizers",), None, "optimizers is missing"),
    (("optimizers",), [1], "optimizers has to be a table of entries"),
    (("schedulers",), 3, "schedulers has to be a table"),
    (("pipeline", EXTRA, "version"), "two", "_extra_state.version has to be a whole number"),
    (("pipeline", EXTRA, "scene"), "[" * 100_000, "does not describe its scene"),
    (("pipeline", EXTRA, "near"), "0.1", "_extra_state.near has to be a number"),
    (("pipeline", EXTRA, "trained_for"), -3, "trained_for has to be from 1"),
    (("pipeline", MEANS), torch.zeros(5, 2), r"scene.surfels.means has to be float32 \[any, 3\], not float32 \[5, 2\]"),
    (("pipeline", MEANS), torch.ones(5, 3, dtype=torch.int32), "means has to be float32 .*, not int32"),
    (("pipeline", MEANS), torch.ones(3, 5).T, "means has to be .*not one after the other in memory"),
    (("pipeline", MEANS), [1.0], "means has to be float32 .*, not list"),
    (("pipeline", MEANS), torch.full((5, 3), 1e30), "means holds numbers that are too large"),
    (("pipeline", "_model.scene.surfels.quats"), torch.ones(4, 4), r"quats has to be float32 \[5, 4\], not"),
    (("pipeline", "_model.scene.surfels.sv_rgb"), None, "sv_rgb is missing"),
    (("pipeline", "_model.scene.surfels.sv_rgb"), torch.ones(5, 6, 3), r"sv_rgb has to be float32 \[5, 7, 3\]"),
    (("pipeline", "_model.scene.surfels.more"), torch.ones(5), "surfels.more belongs to no scene of this preset"),
    (("pipeline", "_model.scene.field.field_table"), torch.ones(4, 15, 4), "of a size that is a power of two"),
    (("pipeline", "_model.scene.field.domain"), torch.zeros(5).double(), "field.domain is no place in space"),
    (("pipeline", "_model.device_indicator_param"), "text", "device_indicator_param has to be numbers"),
    ((*RUN, "random"), torch.zeros(7, dtype=torch.uint8), "run.random is no state of a random generator"),
    ((*RUN, "strategy", "grad_sum"), torch.zeros(3), r"grad_sum has to be float32 \[5\], not float32 \[3\]"),
    ((*RUN, "strategy", "max_radius"), torch.zeros(6), r"max_radius has to be float32 \[5\]"),
    (("pipeline", EXTRA, "train"), "{", "train has to be a table of options as JSON"),
    (("pipeline", EXTRA, "train"), "[1]", "train has to be a table of options as JSON"),
    (("pipeline", EXTRA, "train"), 3, "train has to be a table of options as JSON"),
    ((*RUN, "step_sizes", "footprints"), torch.zeros(5), r"footprints has to be float32 \[5\], above 0"),
    ((*RUN, "step_sizes", "footprints"), torch.ones(4), r"footprints has to be float32 \[5\], above 0"),
    ((*RUN, "poses", "motions"), torch.zeros(3, 6), r"poses.motions has to be float64 \[any, 6\]"),
    ((*RUN, "poses", "motions"), torch.full((3, 6), math.nan).double(), "poses.motions has to be finite"),
    ((*RUN, "poses"), "moved", "poses has to be a table"),
    ((*RUN, "guard", "count"), "many", "guard.count has to be a whole number"),
    ((*RUN, "exposure", "table"), torch.zeros(3, 4), "exposure.table has to be"),
    ((*RUN, "exposure", "optimizer", "state"), {0: {"exp_avg": torch.zeros(3)}}, "optimizer.state.0.exp_avg has"),
    ((*RUN, "exposure", "optimizer"), None, "exposure.optimizer is missing"),
    ((*RUN, "seconds"), math.nan, "run.seconds has to be from 0"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "value", "message"), WRONG, ids=lambda value: str(value)[:40])
def test_every_entry_is_checked_by_kind_shape_and_type(saved: Path, keys: Any, value: Any, message: str) -> None:
    whole = state(SceneConfig())
    at(*keys)(whole, value)
    torch.save(whole, saved)
    refused(saved, message)


UNWRITTEN = [
    *((keys, value, message) for keys, value, message in WRONG if isinstance(value, torch.Tensor) and keys[1] != MEANS),
    (("pipeline", MEANS), torch.ones(6, 3), r"quats has to be float32 \[6, 4\], not float32 \[5, 4\]"),
    (("pipeline", MEANS), torch.ones(5, 3, device="meta"), "means has to be float32"),
    (("optimizers", "quats", "state", 0, "exp_avg"), torch.ones(6, 4), r"quats.*exp_avg has to be float32 \[5, 4"),
    ((*RUN, "texels_start"), 8, "run.texels_start has to be from 0 to 7, not 8"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "value", "message"), UNWRITTEN, ids=lambda value: str(value)[:40])
def test_what_nothing_could_read_is_not_written(saved: Path, keys: Any, value: Any, message: str) -> None:
    whole, before = state(SceneConfig()), saved.read_bytes()
    at(*keys)(whole, value)
    with pytest.raises(InputError, match=f"(?s)could not be written.*{message}.*from {saved.name}, which is intact"):
        checkpoints.save(whole, checkpoints.path_of(saved.parent, 9), saved.parent, SceneConfig())
    assert [path.read_bytes() for path in saved.parent.iterdir()] == [before]


def test_texels_have_to_fit_their_tiles(saved: Path) -> None:
    scene = SceneConfig(texture="texels")
    whole = state(scene)
    torch.save(whole, saved)
    assert checkpoints.load(saved, scene)["step"] == 7
    for name, value in (
        (SIZE, torch.tensor([[2, 4]] + [[0, 0]] * 4, dtype=torch.int32)),
        (SIZE, torch.tensor([[-2, -3]] + [[0, 0]] * 4, dtype=torch.int32)),
        (SIZE, torch.tensor([[65536, 65536]] + [[0, 0]] * 4, dtype=torch.int32)),
        ("_model.scene.field.alpha", torch.ones(7)),
    ):
        torch.save(whole | {"pipeline": whole["pipeline"] | {name: value}}, saved)
        refused(saved, name.removeprefix("_model."), scene)


def test_checkpoints_of_earlier_versions_have_fewer_entries(saved: Path) -> None:
    whole = state(SceneConfig())
    extra = whole["pipeline"][EXTRA]
    for name in ("guard", "step_sizes", "exposure", "poses", "capture"):
        del extra["run"][name]
    for name in ("near", "trained_for"):
        del extra[name]
    del whole["schedulers"]
    torch.save(whole, saved)
    assert checkpoints.load(saved, SceneConfig())["step"] == 7
    del extra["run"]
    torch.save(whole, saved)
    assert checkpoints.load(saved, SceneConfig())["step"] == 7


def test_a_few_numbers_that_cannot_be_drawn_are_a_warning(saved: Path, capsys: Printed) -> None:
    whole = state(SceneConfig())
    whole["pipeline"][MEANS][2, 1], whole["pipeline"]["_model.scene.surfels.quats"][2, 1] = 1e30, torch.nan
    torch.save(whole, saved)
    checkpoints.load(saved, SceneConfig())
    said = " ".join(capsys.readouterr().out.split())
    assert "not finite, or too large to be drawn, in scene.surfels.means, scene.surfels.quats" in said


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_archives_run_nothing(saved: Path, name: str) -> None:
    make, message = HOSTILE[name]
    ran = saved.with_name("ran")
    saved.write_bytes(make(saved.read_bytes(), ran))
    refused(saved, message)
    assert not ran.exists()


@pytest.mark.parametrize("values", [*range(3), "stored"])
def test_archives_are_read_as_torch_reads_them(tmp_path: Path, values: Any) -> None:
    path = tmp_path / "a.ckpt"
    rest, plain = torch.arange(24.0).reshape(4, 6), {"a": (None, 2**70, -1, 0.5, True, "\u00e9")}
    whole = (
        state(SceneConfig())["optimizers"],
        {str(dtype): torch.arange(5).to(dtype) for dtype in _STORAGES.values()} | {"empty": torch.zeros(0, 3)},
        [rest.T, rest[1:, ::2], torch.tensor(3.0), torch.nn.Parameter(rest), plain],
    )
    if values == "stored":
        path = next(Path(__file__).parents[2].glob("e2e/stored/**/*.ckpt"))
    else:
        torch.save(whole[values], path)
    with open(path, "rb") as file:
        assert different(read_archive(file), torch.load(path, weights_only=True)) == []


def test_numbers_of_numpy_are_read_as_numbers(saved: Path) -> None:
    torch.save([np.float64(0.1), np.float32(0.5), np.int64(-3)], saved)
    with open(saved, "rb") as file:
        assert read_archive(file) == [0.1, 0.5, -3]


def test_a_checkpoint_without_permission_is_not_called_damaged(saved: Path, monkeypatch: Patch) -> None:
    def closed(path: Path) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(checkpoints, "open_regular", closed)
    refused(saved, r"cannot be read: Permission denied. Have it made readable for you \(chmod u\+r\)")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda saved: saved["state"][0].update(exp_avg=torch.zeros(3)), r"state.0.exp_avg has to be float32 \[5, 3\]"),
        (lambda saved: saved["state"][0].update(exp_avg_sq=torch.zeros(1, 3).expand(5, 3)), "0.exp_avg_sq has to be"),
        (lambda saved: saved["state"][0].update(exp_avg=torch.zeros(5, 3).double()), "0.exp_avg has to be float32"),
        (lambda saved: saved["state"][0].update(step="three"), "state.0.step has to be"),
        (lambda saved: saved["state"][0].pop("exp_avg"), "state.0.exp_avg is missing"),
        (lambda saved: saved["state"].update({7: saved["state"][0]}), "state.7 belongs to no parameter"),
        (lambda saved: saved.update(state=[1]), "state has to be a table"),
        (lambda saved: saved["param_groups"][0].update(lr="fast"), "param_groups.0.lr has to be a number"),
        (lambda saved: saved["param_groups"][0].update(params=[0, 1]), "params has to be the numbers of 1 parameters"),
        (lambda saved: saved["param_groups"][0].update(params=[torch.zeros(2)]), "params has to be the numbers of 1"),
        (lambda saved: saved.pop("param_groups"), "param_groups is missing"),
    ],
)
def test_moments_that_do_not_fit_never_reach_compiled_code(change: Callable[[Any], Any], message: str) -> None:
    value = torch.ones(5, 3)
    saved = moved(value).state_dict()
    change(saved)
    with pytest.raises(Misfit, match=message):
        restore_optimizer(adam([torch.nn.Parameter(value)]), Entry(saved, "optimizers.means"))


def test_options_of_an_optimiser_are_those_of_the_run() -> None:
    value = torch.ones(5, 3)
    saved = moved(value).state_dict()
    saved["param_groups"][0].update(lr=0.5, amsgrad=True, betas="no pair", capturable=True)
    optimizer = adam([torch.nn.Parameter(value)])
    restore_optimizer(optimizer, Entry(saved, "optimizers.means"))
    group = optimizer.param_groups[0]
    assert (group["lr"], group["amsgrad"], group["betas"]) == (0.5, False, (0.9, 0.999))
    assert bool(optimizer.state[group["params"][0]]["exp_avg"].any())
