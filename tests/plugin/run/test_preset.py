"""Presets state only differences from the defaults, and errors name the file and the key."""

from pathlib import Path

import pytest
import yaml

from bitymi_ns.presets import preset_dir, preset_names
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.preset import Preset, PresetError, load_preset

METHODS = ["bitymi", *(f"bitymi-{name}" for name in ("quality", "fast", "sb", "sg", "sh", "field", "notexture"))]


def test_the_default_preset_is_the_declared_defaults_but_for_the_texture() -> None:
    preset = load_preset("bitymi")
    assert preset == Preset("bitymi", preset.description, scene=SceneConfig(texture="texels"))
    assert sorted(METHODS) == preset_names()


def repeated(values: dict, defaults: object, prefix: str = "") -> list[str]:
    found = []
    for key, value in values.items():
        default = getattr(defaults, key)
        if isinstance(value, dict):
            found += repeated(value, default, f"{prefix}{key}.")
        elif value == default:
            found.append(prefix + key)
    return found


@pytest.mark.parametrize("name", METHODS)
def test_a_preset_describes_itself_and_states_no_default_again(name: str) -> None:
    preset = load_preset(name)
    assert preset.name == name and len(preset.description) > 20
    values = yaml.safe_load((preset_dir() / f"{name}.yaml").read_text("utf8"))
    base = values.pop("base", None)
    assert repeated(values, Preset(name) if base is None else load_preset(base)) == []


def write(folder: Path, text: str, name: str = "mine") -> Path:
    (folder / f"{name}.yaml").write_text(text, "utf8")
    return folder


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("train:\n  loss:\n    falloff_wieght: 1.0", r"mine\.yaml: train\.loss\.falloff_wieght: unknown key"),
        ("scene:\n  levels: four", r"mine\.yaml: scene\.levels: .*valid integer, found 'four'"),
        ("scene:\n  levels: true", r"scene\.levels: .*valid integer, found True"),
        ("scene:\n  view_color: xy", r"scene\.view_color: .*'sv', 'sh', 'sb' or 'sg', found 'xy'"),
        ("bake:\n  tolerance: 1.0", r"mine\.yaml: bake: unknown key"),
        ("scene: 3", r"mine\.yaml: scene: .*found 3"),
        ("train:\n  lr:\n    means: [1.0]", r"train\.lr\.means\.1: .*required"),
        ("train:\n  densify:\n    final_prune_steps: [1, x]", r"final_prune_steps\.1: .*valid integer"),
        ("train:\n  loss:\n    ssim_weight: 2.0", r"train\.loss\.ssim_weight: .*less than or equal to 1, found 2"),
        ("- a\n- b", r"mine\.yaml: expected a mapping"),
        ("a: [", r"mine\.yaml: not valid YAML"),
        ("base: nowhere", r"no preset 'nowhere' \(named as base of mine\.yaml\) in .*, which has mine"),
        ("base: mine", r"mine\.yaml: base: presets refer to each other in a circle"),
        ("base: 3", r"mine\.yaml: base: expected the name of a preset"),
    ],
)
def test_errors_name_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(PresetError, match=message):
        load_preset("mine", write(tmp_path, text))


def test_a_variant_overrides_single_keys_of_its_base(tmp_path: Path) -> None:
    write(tmp_path, "description: d\nscene:\n  levels: 3\n  near: 1e-1", "below")
    preset = load_preset("mine", write(tmp_path, "base: below\nscene:\n  levels: 2"))
    assert (preset.scene.levels, preset.scene.near, preset.description) == (2, 0.1, "d")
