"""Python snippets of the documentation run in page order on a tiny scene."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

import bitymi_ns
from bitymi_ns import sample
from tests.test_docs import PAGES, ROOT

FENCE = re.compile(r"^```python[ \t]*([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
UNTOUCHED = re.compile(r"no-run: \S.*")
"""Info string of a snippet that is not run: ```python no-run: the reason."""
N = 200
"""Points and surfels."""
STEPS = re.compile(r"\bsteps=\d+")


def snippets(text: str) -> tuple[list[str], list[str]]:
    """Split a page's snippets into those that run, and info strings without a reason."""
    found = FENCE.findall(text)
    return [code for info, code in found if not info], [info for info, _ in found if info and not UNTOUCHED.match(info)]


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Names that snippets may use undefined: views and points of a room, and surfels at these points."""
    room = sample.generate(tmp_path_factory.mktemp("snippets") / "room", views=6, width=48, height=36, points=200)
    views = bitymi_ns.load_capture(room)[0]
    g = torch.Generator().manual_seed(0)
    centers = torch.stack([view.camera.center for view in views])
    surfels = {
        "means": centers.mean(0) + torch.randn(N, 3, generator=g),
        "quats": torch.randn(N, 4, generator=g),
        "scales": 0.1 + torch.rand(N, 2, generator=g),
        "opacities": 0.2 + 0.7 * torch.rand(N, generator=g),
        "betas": 0.5 + 3.0 * torch.rand(N, generator=g),
        "colors": torch.rand(N, 3, generator=g),
    }
    return {"room": room, "views": views, "camera": views[0].camera, "points": surfels["means"], **surfels}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_snippets_run(page: Path, names: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runnable, wrong = snippets(page.read_text("utf8"))
    assert not wrong, f"{page.name}: {wrong} is no reason: write ```python no-run: the reason"
    monkeypatch.chdir(tmp_path)
    namespace = dict(names)
    (tmp_path / "room").symlink_to(namespace.pop("room"))
    for code in runnable:
        exec(compile(STEPS.sub("steps=10", code), str(page), "exec"), namespace)
