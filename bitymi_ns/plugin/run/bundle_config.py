"""Where a bundle's config.yml finds its bundle.

nerfstudio's tools read a config.yml and then look for a checkpoint at the place recorded in it. A bundle has none, and
may have been moved since. The functions here find the bundle and give nerfstudio a stand-in for the checkpoint.
"""

from __future__ import annotations

import atexit
import shutil
import sys
import tempfile
from pathlib import Path

import torch

from bitymi_ns.plugin.errors import fail
from bitymi_ns.plugin.run.bundle_model import BakedModelConfig  # noqa: F401 - the config.yml of earlier bundles name it here
from bitymi_ns.plugin.run.commands import folder_being_evaluated

MANIFEST = "bundle.json"


def find_bundle(recorded: Path) -> Path:
    """The folder of the bundle whose config.yml is being loaded."""
    candidates = [*_loaded_from(), recorded]
    for folder in candidates:
        if (folder / MANIFEST).is_file() or folder.is_file():
            return folder.absolute()
    places = ", ".join(str(folder) for folder in dict.fromkeys(candidates))
    fail(f"no bundle found (looked for {MANIFEST} in {places}). Keep config.yml in the bundle's folder.")


def _loaded_from() -> list[Path]:
    """Where the config.yml that is being loaded may be: by eval_setup or, should that change, by the command line."""
    evaluated = folder_being_evaluated()
    folders = [] if evaluated is None else [evaluated]
    for i, argument in enumerate(sys.argv):
        name, _, value = argument.partition("=")
        if name in ("--load-config", "--load_config"):
            value = value or (sys.argv[i + 1] if i + 1 < len(sys.argv) else "")
            folders.append(Path(value).absolute().parent)
    return folders


def stub_checkpoint_dir(bundle: Path) -> Path:
    """A temporary folder with an empty checkpoint, named after the bundle.

    nerfstudio insists on a checkpoint file. It is not kept in the bundle, so that a bundle holds no pickled data. Its
    path ends up in the results of ns-eval, where `bitymi report` tells by it that they are those of a bundle.
    """
    scratch = Path(tempfile.mkdtemp(prefix="bitymi-bundle-"))
    atexit.register(shutil.rmtree, scratch, ignore_errors=True)
    folder = scratch / bundle.name / "nerfstudio_models"
    folder.mkdir(parents=True)
    torch.save(
        {"step": 0, "pipeline": {}, "optimizers": {}, "schedulers": {}, "scalers": {}}, folder / "step-000000000.ckpt"
    )
    return folder
