#!/usr/bin/env python3
"""Print the requirements with the dev extra, one per line without spaces, for the Makefile's pip call."""

import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    from pip._vendor import tomli as tomllib


def main() -> None:
    pyproject = Path(__file__).resolve().parent.parent / "pyproject.toml"
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    for requirement in project["dependencies"] + project["optional-dependencies"]["dev"]:
        print(re.sub(r"\s", "", requirement))


if __name__ == "__main__":
    main()
