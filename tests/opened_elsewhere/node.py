"""npm programs that `make web-test` installs."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

from tests.required import skip_without

HERE = Path(__file__).resolve().parent
MODULES = HERE.parents[1] / "web" / "node_modules"


def said_by(script: str, package: str, file: Path) -> Any:
    """Run a script of this folder that reads a file with an npm package; returns its JSON output, or skips the test
    without the package."""
    node = shutil.which("node")
    if node is None:
        skip_without("npm", "no node: apt install nodejs npm")
    if not (MODULES / package).is_dir():
        skip_without("npm", f"web/node_modules has no {package}: make web-test")
    command = [node, str(HERE / script), str(MODULES), str(file)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
