"""Presets: YAML files of method_configs/, which state differences from the defaults of the dataclasses."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from bitymi_ns.presets import preset_dir
from bitymi_ns.scene.config import SceneConfig
from .config import TrainConfig


class PresetError(ValueError):
    """Invalid preset file; names file and key."""


class Loader(yaml.SafeLoader):
    """YAML loader that reads 1e-3 as a number, not as text like YAML 1.1."""


Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


@dataclass
class Preset:
    """A method: the dataclasses' defaults, overridden by its YAML file."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    name: str
    description: str = ""
    scene: SceneConfig = field(default_factory=SceneConfig)
    train: TrainConfig = field(default_factory=TrainConfig)


def load_preset(name: str, folder: Path | None = None) -> Preset:
    """Read the preset `name` from `folder`; None: the installed presets. Raises PresetError: it is missing or
    invalid."""
    folder = preset_dir() if folder is None else folder
    path = folder / f"{name}.yaml"
    values = _read_with_base(path, folder, ())
    try:
        # strictly: as JSON, lists become tuples, but neither true a number nor 3 a string
        return TypeAdapter(Preset).validate_json(json.dumps({**values, "name": name}, default=str), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        unknown = first["type"] == "unexpected_keyword_argument"
        why = "unknown key" if unknown else f"{first['msg'].lower()}, found {first['input']!r}"
        raise PresetError(f"{path.name}: {'.'.join(map(str, first['loc']))}: {why}") from error


def _read_with_base(path: Path, folder: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """Read a preset file and merge it into its `base`."""
    if path in above:
        raise PresetError(f"{path.name}: base: presets refer to each other in a circle")
    if not path.is_file():
        where = f" (named as base of {above[-1].name})" if above else ""
        there = ", ".join(sorted(file.stem for file in folder.glob("*.yaml"))) or "none; reinstall bitymi-ns"
        raise PresetError(f"there is no preset {path.stem!r}{where} in {folder}, which has {there}")
    try:
        values = yaml.load(path.read_text("utf8"), Loader)
    except yaml.YAMLError as error:
        raise PresetError(f"{path.name}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise PresetError(f"{path.name}: expected a mapping of options, found {type(values).__name__}")
    base = values.pop("base", None)
    if base is None:
        return values
    if not isinstance(base, str):
        raise PresetError(f"{path.name}: base: expected the name of a preset, found {base!r}")
    return _merged(_read_with_base(folder / f"{base}.yaml", folder, (*above, path)), values)


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(below)
    for key, value in above.items():
        if isinstance(value, dict) and isinstance(result.get(key), dict):
            value = _merged(result[key], value)
        result[key] = value
    return result
