"""Changes to nerfstudio: its exporter's commands, its viewer, what its console shows."""

import inspect
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Annotated, Any, Union

import pytest
import tyro
from nerfstudio.configs import external_methods
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.utils.rich_utils import CONSOLE
from rich.panel import Panel

from bitymi_ns.plugin import hooks
from bitymi_ns.plugin.run.config import method_config

First, Second, Third = (type(name, (), {}) for name in ("First", "Second", "Third"))


def test_only_the_exporters_own_union_is_extended(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    fake_tyro = ModuleType("fake_tyro")
    fake_tyro.cli = lambda f, *args, **kwargs: seen.append(f)
    fake_tyro.conf = object()
    module = ModuleType("exporter")
    module.tyro, module.Commands = fake_tyro, Annotated[Union[First, Second], "marker"]  # noqa: UP007
    monkeypatch.setitem(sys.modules, hooks.EXPORTER, module)
    for _ in range(2):  # a second call changes nothing
        hooks.extend_exporter(lambda: [Third])
    module.tyro.cli(First)
    module.tyro.cli(module.Commands)
    assert seen[0] is First
    assert seen[1] == Annotated[Union[First, Second, Third], "marker"]  # noqa: UP007
    assert module.tyro.conf is fake_tyro.conf
    assert fake_tyro.cli is not module.tyro.cli


def test_listing_methods_reads_no_source(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """It asks for the stack whenever nerfstudio is imported; naming such a method still offers its installation."""
    monkeypatch.setattr(inspect, "getmodule", lambda *args: pytest.fail("sources of all callers are searched"))
    configs = external_methods.get_external_methods()[0]
    assert "in2n" in configs
    monkeypatch.setattr(external_methods.Confirm, "ask", lambda *args, **options: False)
    with pytest.raises(SystemExit) as stop:
        replace(configs["in2n"])
    assert stop.value.code == 0 and "instruct-nerf2nerf" in capsys.readouterr().out


@pytest.mark.slow
def test_ns_export_lists_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from nerfstudio.scripts import exporter

    from bitymi_ns.plugin import methods

    hooks.extend_exporter(methods._exports)
    monkeypatch.setattr(sys, "argv", ["ns-export", "--help"])
    with pytest.raises(SystemExit) as stop:
        exporter.entrypoint()
    assert stop.value.code == 0
    output = capsys.readouterr().out
    assert "bitymi-atlas" in output and "gaussian-splat" in output


@pytest.fixture
def hosts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the addresses of started viewers, each ended at once by Ctrl-C."""
    started: list[str] = []

    def start_viewer(config: Any, *_: Any) -> None:
        started.append(config.viewer.websocket_host)
        raise KeyboardInterrupt

    monkeypatch.setattr(run_viewer, "_start_viewer", start_viewer)
    return started


def view(monkeypatch: pytest.MonkeyPatch, config: Any, arguments: list[str], ours: bool = True) -> None:
    def load(*_: Any, **__: Any) -> tuple:
        if ours:
            hooks.patch_viewer(config)
        return config, SimpleNamespace(), None, 0

    arguments = ["--load-config", "config.yml", *arguments]
    monkeypatch.setattr(run_viewer, "eval_setup", load)
    monkeypatch.setattr(sys, "argv", ["ns-viewer", *arguments])
    tyro.cli(tyro.conf.FlagConversionOff[run_viewer.RunViewer], args=arguments).main()


def test_training_serves_this_machine_alone() -> None:
    default = method_config("bitymi").config
    assert default.viewer.websocket_host == "127.0.0.1"
    args = ["--viewer.websocket-host", "0.0.0.0"]
    assert tyro.cli(type(default), default=default, args=args).viewer.websocket_host == "0.0.0.0"


@pytest.mark.parametrize("given", [[], ["--viewer.websocket-host", "10.0.0.5"], ["--viewer.websocket_host=10.0.0.5"]])
def test_ns_viewer_listens_where_it_is_told(
    hosts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], given: list[str]
) -> None:
    view(monkeypatch, method_config("bitymi").config, given)
    assert hosts == ["10.0.0.5" if given else "127.0.0.1"]
    assert "The viewer has ended." in capsys.readouterr().out


def test_scenes_of_other_methods_are_shown_as_before(hosts: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyboardInterrupt):
        view(monkeypatch, method_config("bitymi").config, [], ours=False)
    hooks.patch_viewer(method_config("bitymi").config)  # as if one of ours had been loaded before
    with pytest.raises(KeyboardInterrupt):
        view(monkeypatch, method_config("bitymi").config, [], ours=False)
    assert hosts == ["0.0.0.0", "0.0.0.0"]


def test_whatever_loads_a_run_adopts_the_viewer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    adopted = []
    monkeypatch.setattr("bitymi_ns.plugin.hooks.patch_viewer", adopted.append)
    config = method_config("bitymi").config
    config.output_dir, config.experiment_name = tmp_path, "room"
    config.get_checkpoint_dir()
    assert adopted == []

    def eval_setup(config_path: Path) -> None:
        with pytest.raises(SystemExit, match="no checkpoint folder"):
            config.get_checkpoint_dir()

    eval_setup(tmp_path / "config.yml")
    assert adopted == [config]


def test_brackets_in_what_the_host_says_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    with hooks.print_brackets():
        CONSOLE.log("logging events to: o[/b]/run")
        CONSOLE.print(Panel("p[/b]/run"))
    said = capsys.readouterr().out
    assert "o[/b]/run" in said and "p[/b]/run" in said and "test_hooks.py" in said
