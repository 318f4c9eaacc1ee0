"""The versions that both supported ends were tried with fit what pyproject.toml requires."""

import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


@pytest.mark.parametrize("end", ["oldest", "newest"])
def test_requirements_admit_the_versions_found(load: Callable[[str], ModuleType], end: str) -> None:
    script = load("test_environment")
    head, *lines = (script.FOUND / f"{end}.txt").read_text("utf8").splitlines()
    python = re.match(r"# Python ((\d+\.\d+)\.\d+)", head)
    assert python[2] == script.ENDS[end][0]
    found = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    project = load("requirements").tomllib.loads((script.ROOT / "pyproject.toml").read_text("utf8"))["project"]
    assert python[1] in Requirement(f"python{project['requires-python']}").specifier
    for requirement in map(Requirement, project["dependencies"]):
        if requirement.marker is None or requirement.marker.evaluate({"python_version": python[2]}):
            assert found[canonicalize_name(requirement.name)] in requirement.specifier, str(requirement)


def test_a_python_that_is_not_there_or_does_not_run_is_named(
    load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = load("test_environment")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["test_environment.py", "--work", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"No 'python3\.10' found on PATH"):
        script.main()
    assert not list(tmp_path.iterdir())
    shim = tmp_path / "python3.10"  # as version managers leave, for versions that are not chosen
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(0o755)
    with pytest.raises(SystemExit, match=r"No 'python3\.10' that runs and has venv .*/python3\.10 does not\)"):
        script.main()
    assert list(tmp_path.iterdir()) == [shim]
