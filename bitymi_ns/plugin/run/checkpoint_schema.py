"""Check a checkpoint's entries: names, kinds, shapes and types. Compiled code trusts sizes, so nothing else uses an
entry before."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from bitymi_ns.ops.constants import FEATURES, WIDTH
from bitymi_ns.ops.parameters import GEOMETRY_PARAMETERS
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.ranges import MOST
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.strategy import STATISTICS
from bitymi_ns.trust import json_of

EXTRA_STATE = "_extra_state"  # of torch, for a module's state beside tensors
SCENE = "_model.scene."  # prefix of the scene's parameters
SURFELS = f"{SCENE}surfels."
LARGEST = 1e15  # of a drawable parameter: its square is finite in float32
_FIELD_GROUPS = {"field_table": ("field.field_table",), "field_mlp": tuple(f"field.field_w{i}" for i in (1, 2, 3))}
"""Parameters of the optimisers that are not named after one surfel parameter."""


class Misfit(ValueError):
    """An entry is wrong; the message begins with its name."""


@dataclass(frozen=True)
class Entry:
    """Value of a checkpoint, with its name."""

    value: Any
    name: str = ""

    def refuse(self, must: str) -> NoReturn:
        raise Misfit(f"{self.name} has to be {must}, not {_kind(self.value)}")

    def get(self, key: object) -> Entry | None:
        """Return an entry; None if it is missing or None."""
        value = self.table().get(key)
        return None if value is None else self._part(key, value)

    def __getitem__(self, key: object) -> Entry:
        entry = self.get(key)
        if entry is None:
            raise Misfit(f"{self._part(key, None).name} is missing")
        return entry

    def _part(self, key: object, value: Any) -> Entry:
        return Entry(value, f"{self.name}.{str(key).removeprefix('_model.')}" if self.name else str(key))

    def table(self) -> dict[Any, Any]:
        if not isinstance(self.value, dict):
            self.refuse("a table of entries")
        return self.value

    def parts(self) -> list[Entry]:
        return [self._part(key, value) for key, value in self.table().items()]

    def text(self) -> str:
        if not isinstance(self.value, str):
            self.refuse("text")
        return self.value

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a number, infinite or NaN only without a range."""
        if isinstance(self.value, bool) or not isinstance(self.value, (int, float)):
            self.refuse("a number")
        if not low <= self.value <= high and (low, high) != (-math.inf, math.inf):
            raise Misfit(f"{self.name} has to be from {low:g} to {high:g}, not {str(self.value)[:20]}")
        return self.value

    def count(self, low: int = 0) -> int:
        if not isinstance(self.value, int):
            self.refuse("a whole number")
        return int(self.number(low, MOST))

    def tensor(self, *shape: int | None, dtype: torch.dtype | None = torch.float32) -> Tensor:
        """Return a contiguous tensor of this shape, None = any size; with dtype None, of any shape and dtype. A file's
        strides may reach beyond its numbers, or it may hold none (device meta)."""
        value = self.value
        plain = type(value) in (Tensor, Parameter) and value.layout == torch.strided and not value.is_meta
        fits = plain and dtype in (None, value.dtype) and value.is_contiguous()
        if fits and dtype is not None:
            fits = len(shape) == value.ndim and all(a in (None, b) for a, b in zip(shape, value.shape, strict=True))
        if not fits:
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            self.refuse("numbers" if dtype is None else f"{_name(dtype)} [{sizes}]")
        return value


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _kind(value: Any) -> str:
    if isinstance(value, Tensor):
        laid_out = value.layout == torch.strided and not value.is_meta
        spread = "" if laid_out and value.is_contiguous() else ", not one after the other in memory"
        return f"{_name(value.dtype)} {list(value.shape)}{spread}"
    return "nothing" if value is None else f"{type(value).__name__} {reprlib.repr(value)[:30]}"


def check_unwritten(state: Mapping[str, Any], scene: SceneConfig) -> None:
    """Check a checkpoint, with its optimisers, before it is written, on any device and without a copy."""
    parameters = check_entries(state, scene)
    for optimizer in Entry(state["optimizers"], "optimizers").parts():
        group = optimizer.name.removeprefix("optimizers.")
        names = _FIELD_GROUPS.get(group, (f"surfels.{group}",))
        check_optimizer(optimizer, [Entry(parameters, SCENE)[SCENE + name].value for name in names])


def check(state: Mapping[str, Any], scene: SceneConfig) -> list[str]:
    """Check all entries of a checkpoint; return the names of parameters with numbers that are not finite, or too large
    to be drawn. Raises Misfit."""
    drawable = {
        name.removeprefix("_model."): (values.abs() <= LARGEST).reshape(len(values), -1).all(1)
        for name, values in check_entries(state, scene).items()
    }
    broken = [name for name, rows in drawable.items() if not bool(rows.all())]
    if not bool(torch.stack([drawable[f"scene.surfels.{name}"] for name in GEOMETRY_PARAMETERS]).all(0).any()):
        raise Misfit(f"{broken[0]} holds numbers that are too large, or none, for every surfel")
    return broken


def check_entries(state: Mapping[str, Any], scene: SceneConfig) -> dict[str, Tensor]:
    """Check all entries against the scene's configuration; those that other versions lack may be missing. Return the
    scene's parameters by name. Raises Misfit."""
    root = Entry(dict(state))
    step = root["step"].count()
    pipeline = root["pipeline"]
    parameters = _parameters(pipeline, scene)
    rows = len(pipeline[f"{SURFELS}means"].value)
    for part in pipeline.parts():
        if not part.name.endswith(EXTRA_STATE):
            part.tensor(dtype=None)
    extra = pipeline[f"_model.{EXTRA_STATE}"]
    if near := extra.get("near"):
        near.number(1e-30, 1e30)
    for name, low in (("first_surfels", 0), ("trained_for", 1)):
        if count := extra.get(name):
            count.count(low)
    if options := extra.get("train"):
        try:
            Entry(json_of(options.text()), options.name).table()
        except ValueError as error:
            raise Misfit(f"{options.name} has to be a table of options as JSON") from error
    if (run := extra.get("run")) and run.table():
        _check_run(run, rows, step)
    for entry in (root["optimizers"], root.get("schedulers"), root.get("scalers")):
        if entry is not None:
            entry.table()
    return parameters


def _parameters(pipeline: Entry, scene: SceneConfig) -> dict[str, Tensor]:
    n = len(pipeline[f"{SURFELS}means"].tensor(None, 3))
    if n == 0:
        raise Misfit("it holds no surfels")
    kind = VIEW_COLORS[scene.view_color]
    view = zip(kind.names, kind.shapes(kind.terms_of(getattr(scene, kind.option))), strict=True)
    geometry = ((name, parameter.shape) for name, parameter in GEOMETRY_PARAMETERS.items())
    shapes = {f"{SURFELS}{name}": shape for name, shape in (*geometry, *view)}
    parameters = {name: pipeline[name].tensor(n, *shape) for name, shape in shapes.items()}
    names: tuple[str, ...] = ("field_table", "field_w1", "field_w2", "field_w3", "domain")
    if scene.texture != "hash":
        there = pipeline.table().keys()
        names = ("texels", "size", "extent", "share") if f"{SCENE}field.texels" in there else ()
        names += ("alpha",) if names and f"{SCENE}field.alpha" in there else ()
    field = {name: pipeline[f"{SCENE}field.{name}"] for name in names}
    if "field_table" in field:
        table = field["field_table"].tensor(scene.levels, None, FEATURES)
        if table.shape[1] & (table.shape[1] - 1) or table.shape[1] == 0:
            field["field_table"].refuse("of a size that is a power of two")
        for name, shape in zip(
            ("w1", "w2", "w3"), ((len(table) * FEATURES, WIDTH), (WIDTH, WIDTH), (WIDTH, 3)), strict=True
        ):
            field[f"field_{name}"].tensor(*shape)
        domain = field["domain"].tensor(5, dtype=torch.float64)
        if not bool(domain.isfinite().all()) or not domain[3] > 0:
            raise Misfit(f"{field['domain'].name} is no place in space")
    elif field:
        count = len(field["texels"].tensor(None, 3))
        sides = field["size"].tensor(n, 2, dtype=torch.int32).long()
        field["extent"].tensor(n)
        for name in field.keys() & {"share", "alpha"}:
            field[name].tensor(count)
        if bool((sides < 0).any()) or int(sides.prod(1).double().sum()) != count:
            raise Misfit(f"{field['size'].name} does not add up to the {count} rows of {field['texels'].name}")
    parameters.update({f"{SCENE}field.{name}": entry.value for name, entry in field.items()})
    unknown = [name for name in pipeline.table() if str(name).startswith(SCENE) and name not in parameters]
    if unknown:
        raise Misfit(f"pipeline.{str(unknown[0]).removeprefix('_model.')} belongs to no scene of this preset")
    return parameters


def check_optimizer(optimizer: Entry, parameters: Sequence[Tensor]) -> None:
    """Check the state of Adam, or its kin, for these parameters. Raises Misfit."""
    groups = optimizer["param_groups"]
    if not isinstance(groups.value, list) or len(groups.value) != 1:
        groups.refuse("a list of one group")
    group = Entry(groups.value[0], f"{groups.name}.0")
    numbers = group["params"].value
    plain = isinstance(numbers, list) and all(isinstance(number, int) for number in numbers)  # not tensors
    if not plain or numbers != list(range(len(parameters))):
        group["params"].refuse(f"the numbers of {len(parameters)} parameters")
    group["lr"].number(0.0, MOST)
    for number, value in optimizer["state"].table().items():
        entry = Entry(value, f"{optimizer.name}.state.{number}")
        if not isinstance(number, int) or not 0 <= number < len(parameters):
            raise Misfit(f"{entry.name} belongs to no parameter")
        for name in ("exp_avg", "exp_avg_sq"):
            entry[name].tensor(*parameters[number].shape)
        steps = entry["step"]  # a plain number in sparse optimisers
        steps.tensor() if isinstance(steps.value, Tensor) else steps.count()
        unknown = sorted(map(str, entry.table().keys() - {"step", "exp_avg", "exp_avg_sq"}))
        if unknown:
            raise Misfit(f"{entry.name}.{unknown[0]} is nothing that this optimiser knows")


def restore_optimizer(optimizer: Optimizer, saved: Entry) -> None:
    """Check and load the state of an optimiser of one group; its options but the learning rate are this run's."""
    check_optimizer(saved, [parameter for group in optimizer.param_groups for parameter in group["params"]])
    groups = optimizer.state_dict()["param_groups"]
    groups[0]["lr"] = saved.value["param_groups"][0]["lr"]
    optimizer.load_state_dict({"state": saved.value["state"], "param_groups": groups})


def _check_run(run: Entry, rows: int, step: int) -> None:
    if length := run.get("max_steps"):
        length.count(1)
    if start := run.get("texels_start"):
        start.number(0, step)
        start.count()
    strategy = run["strategy"]
    for most in (strategy.get("most_by_memory"), run.get("texels_by_memory")):
        if most is not None:
            most.count()
    first = strategy[STATISTICS[0]].tensor(None)
    if len(first) not in (0, rows):
        strategy[STATISTICS[0]].refuse(f"float32 [{rows}]")
    for name in STATISTICS:
        strategy[name].tensor(len(first))
    for state in (strategy["generator"], run["random"]):
        numbers = state.tensor(None, dtype=torch.uint8)
        try:
            torch.Generator().set_state(numbers)
        except RuntimeError as error:
            raise Misfit(f"{state.name} is no state of a random generator") from error
    if sizes := run.get("step_sizes"):
        footprints = sizes["footprints"].tensor(None)
        if len(footprints) not in (0, rows) or not bool((footprints > 0).all()):
            sizes["footprints"].refuse(f"float32 [{rows}], above 0")
    if guard := run.get("guard"):
        for name in ("factor", "limit", "sum"):
            guard[name].number()
        for name in ("rollbacks", "count"):
            guard[name].count()
    for name in ("seconds", "cpu_seconds"):
        run[name].number(0.0, 1e12)
    if capture := run.get("capture"):
        capture["views"].count()
        capture["names"].text()
        capture["poses"].text()
    if (poses := run.get("poses")) and (motions := poses.get("motions")):
        if not bool((motions.tensor(None, 6, dtype=torch.float64).abs() <= LARGEST).all()):
            motions.refuse("finite")
    if exposure := run.get("exposure"):
        exposure["kind"].text()
        exposure["finding"].text()
        if not isinstance(exposure["decided"].value, bool):
            exposure["decided"].refuse("true or false")
        if table := exposure.get("table"):
            columns = table.tensor(None, None).shape[1]
            if columns not in (3, 12):
                table.refuse("float32 [any, 3] or [any, 12]")
            check_optimizer(exposure["optimizer"], [table.value])
