"""The torchvision remedy: its files, and that nerfstudio's torchvision imports work with it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scripts import torchvision_remedy as remedy


def python(code: str, *path: Path) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter, with `path` first and unaffected by site's .pth files."""
    setup = f"import sys; sys.path[:0] = {[str(p) for p in path]!r}\n"
    return subprocess.run([sys.executable, "-c", setup + code], capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_torchvision_imports_here() -> None:
    result = python(
        "import torchvision, torchvision.models, torchvision.transforms, torchvision.utils, torch\n"
        "torchvision.models.alexnet(weights=None)\n"
        "assert torchvision.transforms.functional.resize(torch.zeros(3, 8, 8), [4, 4]).shape == (3, 4, 4)\n"
        "assert torchvision.utils.make_grid(torch.zeros(2, 3, 4, 4)).shape[0] == 3\n"
    )
    assert result.returncode == 0, result.stderr


def fake(folder: Path, version: str, cuda: str | None) -> None:
    """Write a torchvision that fails like the real one without nms, and a torch that records declarations."""
    (folder / "torchvision").mkdir(parents=True)
    (folder / "torchvision" / "version.py").write_text(f"__version__ = '{version}'\n")
    (folder / "torchvision" / "__init__.py").write_text(
        "import torch\n"
        "for name in ('nms', 'qnms'):\n"
        "    if name not in torch.declared:\n"
        "        raise RuntimeError(f'operator torchvision::{name} does not exist')\n"
    )
    (folder / "torch.py").write_text(
        "declared = []\n"
        f"class version: cuda = {cuda!r}\n"
        "class library:\n"
        "    class Library:\n"
        "        def __init__(self, name, kind): assert (name, kind) == ('torchvision', 'FRAGMENT')\n"
        "        def define(self, schema): declared.append(schema.split('(')[0])\n"
    )


@pytest.mark.parametrize(
    ("version", "cuda", "works"),
    [("0.28.0+cu130", None, True), ("0.28.0+cpu", None, False), ("0.28.0+cu130", "13.0", False)],
)
def test_acts_only_on_the_mismatch(tmp_path: Path, version: str, cuda: str | None, works: bool) -> None:
    fake(tmp_path, version, cuda)
    (tmp_path / "shim_under_test.py").write_text(remedy.SHIM)
    code = "import sys\nsys.meta_path = [f for f in sys.meta_path if type(f).__name__ != '_Finder']\n"
    result = python(code + "import shim_under_test\nassert 'torch' not in sys.modules\nimport torchvision", tmp_path)
    assert (result.returncode == 0) is works, result.stderr
    if not works:
        assert remedy.SYMPTOM in result.stderr


NMS = "RuntimeError: operator torchvision::nms does not exist"


@pytest.mark.parametrize(
    ("prefix", "errors", "status", "left"),
    [
        ("elsewhere", [""], 0, 0),
        ("elsewhere", [NMS, ""], 0, 2),
        ("elsewhere", [NMS, "still broken"], 1, 0),
        ("elsewhere", ["ImportError: something else"], 1, 0),
        (sys.prefix, [], 2, 0),  # no virtual environment
    ],
)
def test_files_are_written_when_needed_and_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefix: str, errors: Any, status: int, left: int
) -> None:
    answers, files = iter(errors), (tmp_path / "shim.py", tmp_path / "shim.pth")
    monkeypatch.setattr(remedy, "shim_files", lambda: files)
    monkeypatch.setattr(remedy, "import_error", lambda: next(answers))
    monkeypatch.setattr(sys, "base_prefix", prefix)
    assert remedy.main() == status
    assert len(list(tmp_path.iterdir())) == left
