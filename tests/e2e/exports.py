"""Exports of runs, and nerfstudio's evaluation of them."""

import json
from pathlib import Path
from typing import Any

from nerfstudio.scripts.eval import ComputePSNR

from bitymi_ns.plugin.export.command import ExportAtlas
from bitymi_ns.plugin.run.config import BitymiTrainerConfig

TOLERANCE = 0.02


def run_export(config: BitymiTrainerConfig, folder: Path, **options: Any) -> None:
    given = {"polish_steps": 0, "format": "bc7", **options}
    ExportAtlas(load_config=config.get_base_dir() / "config.yml", output_dir=folder, **given).main()


def evaluate(config: Path, output: Path) -> dict[str, float]:
    ComputePSNR(load_config=config, output_path=output).main()
    text = output.read_text()
    assert "NaN" not in text
    return json.loads(text)["results"]
