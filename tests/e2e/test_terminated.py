"""A batch system that ends nerfstudio's commands: one line, and nothing left."""

import os
import re
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run

NATIVE = ("***", "Traceback", "terminate called", "Aborted", "Segmentation")
SCRIPTS = "nerfstudio.scripts."


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("localhost", 0))
        return int(taken.getsockname()[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "of"),
    [("viewer.run_viewer", "bundle"), ("eval", "bundle"), ("eval", "trained"), ("exporter", "trained")],
)
def test_terminated_commands_leave_nothing(command: str, of: str, trained: Run, bundle: Path, tmp_path: Path) -> None:
    temporary, output = tmp_path / "temporary", tmp_path / "output"
    temporary.mkdir()
    config = (trained.get_base_dir() if of == "trained" else bundle) / "config.yml"
    arguments = {
        "viewer.run_viewer": ["--viewer.websocket-port", str(free_port())],
        "eval": ["--output-path", f"{output}.json"],
        "exporter": ["bitymi-atlas", "--output-dir", str(output)],
    }[command]
    line = [sys.executable, "-m", SCRIPTS + command, *arguments, "--load-config", str(config)]
    heeds = partial(signal.signal, signal.SIGTERM, signal.SIG_DFL)
    environment = {**os.environ, "TMPDIR": str(temporary), "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}
    said = []
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, preexec_fn=heeds
    ) as process:
        assert process.stdout is not None
        for text in process.stdout:
            said.append(text)
            if "Held out for evaluation" in text:
                process.terminate()
                said.append(process.stdout.read())
                break
    printed = "".join(said)
    after = printed[printed.index("Held out for evaluation") :].splitlines()[1:]
    ends = [line for line in after if re.search("interrupted|The viewer has ended", line)]
    assert len(ends) == 1 and [line for line in after if line.strip()][-1] == ends[0], printed
    assert not any(word in printed for word in NATIVE), printed
    assert process.returncode in (0, 130, -signal.SIGINT) and sorted(each.name for each in tmp_path.iterdir()) == [
        "temporary"
    ]
    left = [path for path in temporary.rglob("*") if not path.name.startswith("torchinductor_")]  # torch's own cache
    assert left == [], left
