"""Registry entries, without a GPU, and without breaking nerfstudio."""

import importlib
import re
import shutil
import sys
import warnings
from pathlib import Path

import pytest
import torch
import tyro
import yaml
from nerfstudio.plugins import registry
from nerfstudio.plugins.types import MethodSpecification

import bitymi_ns.plugin.run.config as config
from bitymi_ns.plugin import hooks, methods
from bitymi_ns.plugin.run.bundle_model import BakedModelConfig
from bitymi_ns.presets import preset_dir
from bitymi_ns.train import preset
from tests.plugin.run.test_preset import METHODS


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_registered_under_its_name(name: str) -> None:
    specification = getattr(methods, name.replace("-", "_"))
    assert isinstance(specification, MethodSpecification)
    assert specification.config.method_name == name
    assert not specification.description.startswith("not available")


def test_a_preset_of_ones_own_is_a_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(preset_dir(), tmp_path / "method_configs")
    (tmp_path / "method_configs/my-own.yaml").write_text("base: bitymi\nscene: {weight_bound: 0.03}\n")
    monkeypatch.setattr(preset, "preset_dir", lambda: tmp_path / "method_configs")
    monkeypatch.setenv("NERFSTUDIO_METHOD_CONFIGS", "my-own=bitymi_ns.plugin.methods:my_own")
    found = registry.discover_methods()[0]["my-own"]
    assert found.method_name == "my-own" and found.pipeline.model.scene.weight_bound == 0.03


def test_a_method_parses_from_the_command_line() -> None:
    default = config.method_config("bitymi").config  # that of the registry may have been used
    args = (
        "--pipeline.model.train.loss.falloff-weight 0.001 --vis none --pipeline.model.scene.levels 3 --max-surfels 5000"
    )
    parsed = tyro.cli(type(default), default=default, args=args.split())
    assert parsed.pipeline.model.train.loss.falloff_weight == 0.001
    assert parsed.pipeline.model.scene.levels == 3
    assert parsed.pipeline.model.train.densify.max_surfels == 5000
    assert parsed.vis == "none" and not parsed.is_viewer_enabled()
    assert parsed.max_num_iterations is None
    dataparser = parsed.pipeline.datamanager.dataparser  # the split of 3DGS
    assert (dataparser.eval_mode, dataparser.eval_interval, dataparser.points) == ("interval", 8, "auto")


def test_the_help_explains_every_option_that_does_something(capsys: pytest.CaptureFixture[str]) -> None:
    default = config.method_config("bitymi").config  # that of the registry may have been used
    with pytest.raises(SystemExit):
        tyro.cli(type(default), default=default, args=["--help"])
    text = capsys.readouterr().out
    # an option on a line, its help indented below
    lines = [line.strip("│| ") for line in text.splitlines()]
    options = [i for i, line in enumerate(lines) if re.match("--[a-z]", line)]
    assert len(options) > 100
    for i in options:
        following = " ".join(lines[i + 1 : i + 3])
        assert len(following.split("(default")[0]) > 10, lines[i]
    # nerfstudio's options without effect
    for dead in ("--optimizers.", "collider", "fps", "loss-coefficients", "eval-num-rays", "prompt"):
        assert dead not in text


def fresh() -> config.BitymiTrainerConfig:
    return config.method_config("bitymi").config


@pytest.mark.parametrize(("problem", "steps"), [(None, 30_000), ("the card is too old", 3000)])
def test_a_gpu_gets_the_full_run_and_a_cpu_a_short_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], problem: str | None, steps: int
) -> None:
    monkeypatch.setattr(config, "why_not_cuda", lambda: problem)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    run = fresh()
    run.machine.device_type = "cuda"
    run.set_timestamp()
    assert run.max_num_iterations == steps
    assert ("on the CPU instead of cuda: the card is too old" in capsys.readouterr().out) is (problem is not None)
    if problem is not None:
        assert run.machine.device_type == "cpu" and run.steps_per_save == 600
        assert "3,000 steps on cpu, a short run" in run.length()


def test_a_given_length_is_kept_where_it_makes_sense() -> None:
    run = fresh()
    run.machine.device_type, run.max_num_iterations, run.steps_per_save = "cpu", 77, 5
    run.set_timestamp()
    assert (run.max_num_iterations, run.steps_per_save) == (77, 5) and run.length() == "77 steps on cpu"
    run.max_num_iterations = 0
    with pytest.raises(SystemExit, match="bitymi: .*at least 1"):
        run.set_timestamp()


def test_a_failing_configuration_leaves_nerfstudio_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bitymi_ns.plugin.run.config", None)  # importing it raises ImportError
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            importlib.reload(methods)
            specification = methods.bitymi_sh
        assert sum("not available" in str(w.message) for w in caught) == 1
        assert isinstance(specification, MethodSpecification)
        assert specification.config.method_name == "bitymi-sh"
        assert "not available" in specification.description
        union = tyro.extras.subcommand_type_from_defaults({"bitymi": methods.bitymi.config, "other": fresh()})
        parsed = tyro.cli(tyro.conf.FlagConversionOff[union], args=["bitymi"])
        with pytest.raises(SystemExit, match="bitymi is not available: "):
            parsed.set_timestamp()
    finally:
        monkeypatch.undo()
        importlib.reload(methods)


CHANGES = ("read_names_of_callers", "extend_exporter", "find_config")


@pytest.mark.parametrize("failing", CHANGES[:2])
def test_a_failing_change_takes_no_other_with_it(monkeypatch: pytest.MonkeyPatch, failing: str) -> None:
    made = []

    def change(name: str) -> None:
        made.append(name)
        if name == failing:
            raise AttributeError("no such thing")

    for name in CHANGES:
        monkeypatch.setattr(hooks, name, lambda *_, name=name: change(name))
    with pytest.warns(UserWarning, match="AttributeError: no such thing"):
        methods._install()
    assert made == list(CHANGES)


@pytest.mark.parametrize("model", [None, BakedModelConfig(background=(1.0, 1.0, 1.0))])
def test_a_config_of_an_earlier_version_loads(model: BakedModelConfig | None) -> None:
    run = fresh()
    run.pipeline.model = model or run.pipeline.model
    text = yaml.dump(run)
    text = re.sub("( +)falloff_gamma", r"\1falloff_error: l1_sum\n\1falloff_gamma", text)  # removed options
    text = re.sub("( +)max_norm", r"\1fused: true\n\1max_norm", text)
    assert yaml.load(text, yaml.Loader) == run


def test_a_capture_given_to_its_parser_names_the_experiment() -> None:
    run = fresh()
    run.pipeline.datamanager.dataparser.data = config.Path("captures/lego")
    run.set_timestamp()
    run.set_experiment_name()
    assert run.experiment_name == "lego" and run.pipeline.datamanager.data.is_absolute()
