#!/usr/bin/env python3
"""Install the wheel beside the oldest and the newest packages that are supported, and try it there:
scripts/test_environment.py --work FOLDER [--data CAPTURE] [--end oldest|newest]

The oldest is nerfstudio's documented environment, in which pip must change nothing. The newest is what pip gives
without constraints.txt, with the newest releases of what nerfstudio's requirements hold back. The versions of what the
package requires, and of what pip must leave alone, are written to scripts/environments, which tests/scripts compares
with pyproject.toml."""

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOUND = ROOT / "scripts" / "environments"
NERFSTUDIO = "nerfstudio==1.1.5"
ENDS = {
    "oldest": ("3.10", [["torch==2.1.2", "torchvision==0.16.2"], [NERFSTUDIO]], []),
    "newest": ("3.12", [[NERFSTUDIO]], ["numpy", "opencv-python-headless", "open3d", "av"]),
}
"""By name: the Python, what is installed before the wheel, and what is renewed after it whatever requires less."""
KEPT = {"torch", "torchvision", "numpy", "gsplat", "nerfacc", "opencv-python-headless", "open3d"}
TESTS = [f"tests/{name}" for name in "codec ops train scene bundle interchange plugin capture bake".split()]
SHORT, LONG = 100, 120  # steps of the run, and of the one that goes on with it


class Environment:
    """A new virtual environment in `folder`, outside the checkout."""

    def __init__(self, interpreter: str, folder: Path) -> None:
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([interpreter, "-m", "venv", folder / "venv"], check=True)

    def run(self, program: str, *words: object, cwd: Path | None = None) -> str:
        """Run a program of the environment and return its output; exit if it fails."""
        programs = self.folder / "venv" / "bin"
        variables = {"OMP_NUM_THREADS": "2"} | os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}
        print("+", program, *words, flush=True)
        command = [programs / program, *map(str, words)]
        done = subprocess.run(
            command, cwd=cwd or self.folder, env=variables, stdout=subprocess.PIPE, text=True, check=False
        )
        if done.returncode:
            sys.exit(f"{done.stdout}\ntest environment: exit status {done.returncode} of {program} in {self.folder}")
        return done.stdout

    def pip(self, *words: object) -> str:
        return self.run("python", "-m", "pip", "--disable-pip-version-check", *words)

    def versions(self) -> dict[str, str]:
        """Return the packages' versions by name, in lower case."""
        pairs = (line.split("==") for line in self.pip("list", "--format=freeze").splitlines())
        return dict(sorted((name.lower().replace("_", "-"), version) for name, version in pairs))


def interpreter_of(version: str) -> str:
    """Find a Python on PATH that runs and has venv; exit if there is none."""
    path = shutil.which(f"python{version}")
    tried = path and subprocess.run([path, "-c", "import ensurepip, venv"], capture_output=True, check=False)
    if path and tried and tried.returncode == 0:
        return path
    sys.exit(
        f"No 'python{version}' {f'that runs and has venv ({path} does not)' if path else 'found'} on PATH: install it "
        "with venv, or name the other end alone (make test-environment ENDS=...)"
    )


def try_commands(environment: Environment, data: Path | None) -> None:
    """Train a capture or the sample room, go on with the run, evaluate and export it."""
    folder = environment.folder
    train = ["bitymi", "--vis", "tensorboard", "--output-dir", "runs", "--timestamp", "run"]
    if data is None:
        data = folder / "room"
        environment.run("bitymi", "sample", "--output-dir", data)
    for steps, name, more in (
        (SHORT, "short", []),
        (LONG, "long", ["--load-dir", "runs/short/bitymi/run/nerfstudio_models"]),
    ):
        options = ["--experiment-name", name, "--max-num-iterations", steps, *more]
        environment.run("ns-train", *train, "--data", data, *options)
    config = ["--load-config", "runs/long/bitymi/run/config.yml"]
    environment.run("ns-eval", *config, "--output-path", "eval.json")
    print((folder / "eval.json").read_text())
    environment.run("ns-export", "bitymi-atlas", *config, "--output-dir", "bundle")
    environment.run("ns-eval", "--load-config", "bundle/config.yml", "--output-path", "bundle.json")
    environment.run("ns-export", "bitymi-mesh", *config, "--output-dir", "mesh")


def try_end(name: str, work: Path, data: Path | None) -> None:
    """Try one environment, and write the versions found."""
    version, first, renewed = ENDS[name]
    environment = Environment(interpreter_of(version), work / name)
    for packages in first:
        environment.pip("install", "-q", *packages)
    before = environment.versions()
    environment.pip("wheel", "-q", "--no-deps", "--config-settings=cmake.define.BITYMI_CUDA=OFF", "-w", "dist", ROOT)
    (wheel,) = (environment.folder / "dist").glob("*.whl")
    environment.pip("install", "-q", wheel)
    after = environment.versions()
    print(f"{name}: pip adds {sorted(after.keys() - before.keys())}")
    if changed := {package for package in before if after.get(package) != before[package]} & KEPT:
        sys.exit(f"test environment: pip changes {sorted(changed)} of the {name} environment")
    if renewed:
        environment.pip("install", "-q", "--upgrade", "--no-deps", *renewed)
    required = environment.pip("show", "bitymi-ns").split("Requires: ")[1].splitlines()[0].lower().replace("_", "-")
    recorded = KEPT | {*required.split(", ")}
    versions = environment.versions().items()
    lines = "".join(f"{package}=={version}\n" for package, version in versions if package in recorded)
    python = environment.run("python", "-c", "import platform; print(platform.python_version())").strip()
    (FOUND / f"{name}.txt").write_text(f"# Python {python}: written by scripts/test_environment.py\n{lines}", "utf8")
    try_commands(environment, data)
    try_tests(environment)


def try_tests(environment: Environment) -> None:
    """Run tests on a copy of the checkout without the package."""
    environment.pip("install", "-q", "pytest", "hypothesis", "plyfile", "texture2ddecoder")
    away = environment.folder / "away"
    shutil.rmtree(away, ignore_errors=True)
    unwanted = ("bitymi_ns", ".*", "__pycache__", "build", "outputs", "demo", "node_modules")
    shutil.copytree(ROOT, away, ignore=shutil.ignore_patterns(*unwanted))
    print(environment.run("python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", *TESTS, cwd=away))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--end", action="append", choices=list(ENDS), help="one of the two; may be repeated")
    parser.add_argument("--data", type=Path, help="a capture; the sample room without")
    parser.add_argument("--work", type=Path, required=True, help="folder of the environments, outside the checkout")
    options = parser.parse_args()
    ends = options.end or list(ENDS)
    for name in ends:
        interpreter_of(ENDS[name][0])
    for name in ends:
        try_end(name, options.work.absolute(), options.data and options.data.absolute())


if __name__ == "__main__":
    main()
