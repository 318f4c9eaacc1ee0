"""The GPU benchmark of frame times, run in emulation: its table is complete."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.cuda.conftest import why_not_emulated
from tests.required import skip_without

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "times.py"


@pytest.mark.slow
def test_frames_without_a_card(tmp_path: Path) -> None:
    """A failing row is a line of the page and could go unnoticed."""
    if reason := why_not_emulated():
        skip_without("emulated", reason)
    page = tmp_path / "page.md"
    command = [sys.executable, str(SCRIPT), "frames", "--emulated", "--output", str(page)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    text = page.read_text("utf8")
    assert "Failed" not in text and text.count("\n|") == 3
