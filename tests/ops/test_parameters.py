"""A row of the table of surfel parameters is all that names, shapes, limits, rates and columns need."""

import subprocess
import sys
from pathlib import Path

from bitymi_ns.ops import parameters

CODE = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("bitymi_ns.ops.parameters", sys.argv[1])
module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
row = module.Parameter("gloss", (2,), (5.0,), "log_scales", 0.5, columns=("gloss_u", "gloss_v"))
module.GEOMETRY_PARAMETERS["gloss"] = row

import pytest, torch
from bitymi_ns.ply import PlyError
from bitymi_ns.bundle.surfel_table import from_columns, to_columns
from bitymi_ns.codec.limits import within
from bitymi_ns.plugin.run.checkpoint_schema import Entry, Misfit, _parameters
from bitymi_ns.plugin.run.model import PARAMETER_GROUPS
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.schedules import Schedule
from tests.bake.conftest import make_surfels

surfels = {**make_surfels(5), "gloss": torch.rand(5, 2)}
scene = BakedScene(surfels, "sv", torch.zeros(5, 5, dtype=torch.int32), near=0.1)
columns = to_columns(scene)
assert {"gloss_u", "gloss_v"} <= columns.keys()
assert torch.equal(from_columns(columns, "sv")["surfels"]["gloss"], surfels["gloss"])
columns["gloss_v"] = columns["gloss_v"] + 9
with pytest.raises(PlyError, match="gloss_v"):
    from_columns(columns, "sv")
assert within({**surfels, "gloss": 9 * torch.ones(5, 2)}, "sv").sum() == 0
schedule = Schedule(TrainConfig(), 100, 1.0)
assert schedule.lr("gloss", 3) == 0.5 * schedule.lr("log_scales", 3) and "gloss" in PARAMETER_GROUPS
state = {f"_model.scene.surfels.{name}": value for name, value in surfels.items()}
assert "_model.scene.surfels.gloss" in _parameters(Entry(state), SceneConfig(texture="none"))
state["_model.scene.surfels.gloss"] = torch.rand(5, 3)
with pytest.raises(Misfit, match="gloss"):
    _parameters(Entry(state), SceneConfig(texture="none"))
"""


def test_a_row_is_known_everywhere() -> None:
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(parameters.__file__)], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
