"""The tables of options name options that exist, with their defaults."""

import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from bitymi_ns.bake import BakeOptions
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.preset import load_preset

ROOT = Path(__file__).resolve().parents[1]
ROOTS: dict[str, Any] = {
    "--pipeline.model.scene.": load_preset("bitymi").scene,
    "--pipeline.model.train.": TrainConfig(),
    "--": TrainConfig().densify,  # short names of its options
    "ns-export ... --": BakeOptions(),
}
ELSEWHERE = {"--machine.num-devices", "--machine.seed", "--max-num-iterations", "--pipeline.model.train.first-surfels"}
ELSEWHERE |= {
    f"ns-export ... --{name}"
    for name in "exact finetune-steps format photographs polish-steps compact-error target-mb".split()
}
"""Options declared with the commands, which need nerfstudio."""


def value_of(option: str) -> Any:
    prefix = max((root for root in ROOTS if option.startswith(root)), key=len)
    value = ROOTS[prefix]
    for name in option.removeprefix(prefix).replace("-", "_").split("."):
        assert is_dataclass(value) and name in {field.name for field in fields(value)}, f"there is no option {option}"
        value = getattr(value, name)
    return value


def test_options_have_the_defaults_that_the_pages_state() -> None:
    tables = [
        (ROOT / "docs" / page).read_text("utf8").split("## Options\n")[1].split("\n## ")[0]
        for page in ("training.md", "baking.md")
    ]
    rows = [line.strip("|").split("|") for table in tables for line in table.splitlines() if line.startswith("| `")]
    checked = 0
    for names, stated, _ in rows:
        option = re.findall(r"`([^`]+)`", names)[0]
        if option in ELSEWHERE:
            continue
        value, word = value_of(option), stated.strip().removesuffix(" (none)")
        assert word == (f"{value:g}" if isinstance(value, float) else str(value)), f"{option} is {value}"
        checked += 1
    assert checked > 8
