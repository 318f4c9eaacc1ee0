"""The viewer listens on this machine only by default, and Ctrl-C ends it without a traceback."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("nerfstudio")

import tyro
from nerfstudio.scripts.viewer import run_viewer

from bitymi_ns.plugin.run.commands import adopt_viewer
from bitymi_ns.plugin.run.config import method_config


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
    """Run ns-viewer with these arguments on a loaded scene."""

    def load(*_: Any, **__: Any) -> tuple:
        if ours:
            adopt_viewer(config)
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


@pytest.mark.parametrize(
    ("arguments", "host"),
    [
        ([], "127.0.0.1"),
        (["--viewer.websocket-host", "0.0.0.0"], "0.0.0.0"),
        (["--viewer.websocket_host=0.0.0.0"], "0.0.0.0"),
        (["--viewer.websocket-host", "10.0.0.5"], "10.0.0.5"),
    ],
)
def test_ns_viewer_listens_where_it_is_told(
    hosts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: Any, host: str
) -> None:
    view(monkeypatch, method_config("bitymi").config, arguments)
    assert hosts == [host]
    assert "The viewer has ended." in capsys.readouterr().out


def test_scenes_of_other_methods_are_shown_as_before(hosts: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyboardInterrupt):
        view(monkeypatch, method_config("bitymi").config, [], ours=False)
    adopt_viewer(method_config("bitymi").config)  # as if one of ours had been loaded before
    with pytest.raises(KeyboardInterrupt):
        view(monkeypatch, method_config("bitymi").config, [], ours=False)
    assert hosts == ["0.0.0.0", "0.0.0.0"]


def test_whatever_loads_a_run_adopts_the_viewer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    adopted = []
    monkeypatch.setattr("bitymi_ns.plugin.run.config.adopt_viewer", adopted.append)
    config = method_config("bitymi").config
    config.output_dir, config.experiment_name = tmp_path, "room"
    config.get_checkpoint_dir()
    assert adopted == []

    def eval_setup(config_path: Path) -> None:
        with pytest.raises(SystemExit, match="no checkpoint folder"):
            config.get_checkpoint_dir()

    eval_setup(tmp_path / "config.yml")
    assert adopted == [config]
