"""`ns-export` gets its additional command, in any order of loading the plugin."""

import importlib
import sys
from types import ModuleType
from typing import Union, get_args

import pytest

pytest.importorskip("nerfstudio")


from bitymi_ns.plugin.export import hook

First, Second = (type(name, (), {}) for name in ("First", "Second"))


def test_only_the_exporters_own_union_is_extended() -> None:
    seen = []
    fake_tyro = ModuleType("fake_tyro")
    fake_tyro.cli = lambda f, *args, **kwargs: seen.append(f)
    fake_tyro.conf = object()
    module = ModuleType("exporter")
    module.tyro, module.Commands = fake_tyro, Union[First, Second]  # noqa: UP007
    hook.patch(module)
    hook.patch(module)  # a second call changes nothing
    module.tyro.cli(First)
    module.tyro.cli(module.Commands)
    assert seen[0] is First
    assert len(get_args(seen[1])) == 4
    assert module.tyro.conf is fake_tyro.conf
    assert fake_tyro.cli is not module.tyro.cli


def test_an_exporter_that_is_imported_later_is_patched(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    package = tmp_path / "later_pkg"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "exporter.py").write_text("import tyro\nclass A: pass\nclass B: pass\nCommands = A\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(hook, "EXPORTER", "later_pkg.exporter")
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    hook.install()
    module = importlib.import_module("later_pkg.exporter")
    assert isinstance(module.tyro, hook._TyroProxy)
    assert not any(isinstance(f, hook._ExporterFinder) for f in sys.meta_path)


@pytest.mark.slow
def test_ns_export_lists_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from nerfstudio.scripts import exporter

    from bitymi_ns.plugin import methods  # noqa: F401 - installs the hook

    hook.patch(exporter)
    monkeypatch.setattr(sys, "argv", ["ns-export", "--help"])
    with pytest.raises(SystemExit) as stop:
        exporter.entrypoint()
    assert stop.value.code == 0
    output = capsys.readouterr().out
    assert "bitymi-atlas" in output and "gaussian-splat" in output
