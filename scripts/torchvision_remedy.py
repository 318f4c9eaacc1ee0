#!/usr/bin/env python3
"""Make a CUDA build of torchvision importable beside a CPU build of torch, in this virtual environment.

Without this, `import torchvision`, and so nerfstudio, fails with "operator torchvision::nms does not exist". The better
solution is the matching CPU wheel (https://download.pytorch.org/whl/cpu). Only on this message the script adds two
files to site-packages that declare the missing operators when torchvision is imported."""

import subprocess
import sys
import sysconfig
from pathlib import Path

SHIM_NAME = "_torchvision_cpu_shim"
SYMPTOM = "operator torchvision::nms does not exist"

SHIM = '''"""Written by scripts/torchvision_remedy.py: lets a CUDA torchvision import beside a CPU torch."""

import importlib.abc
import importlib.machinery
import sys


def _mismatch(spec):
    """True if torchvision is a CUDA build and torch is not."""
    import os

    try:
        with open(os.path.join(os.path.dirname(spec.origin), "version.py"), encoding="utf-8") as file:
            if "+cu" not in file.read():
                return False
    except (OSError, TypeError):
        return False
    import torch

    return torch.version.cuda is None


class _Finder(importlib.abc.MetaPathFinder):
    """Finds nothing; declares the missing operators when torchvision is first looked up."""

    def find_spec(self, fullname, path=None, target=None):
        if fullname != "torchvision":
            return None
        sys.meta_path.remove(self)
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and _mismatch(spec):
            import torch

            # FRAGMENT: may be declared beside another library of the same name. Kept alive as an attribute.
            self.library = torch.library.Library("torchvision", "FRAGMENT")
            self.library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
            self.library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
            sys.modules[__name__].library = self.library
        return None


sys.meta_path.insert(0, _Finder())
'''


def shim_files() -> tuple[Path, Path]:
    """Return the paths of the shim module and of the .pth file that loads it at start-up."""
    site = Path(sysconfig.get_paths()["purelib"])
    return site / f"{SHIM_NAME}.py", site / f"{SHIM_NAME}.pth"


def import_error() -> str:
    """Return the error output of `import torchvision` in a new interpreter, not from the current folder."""
    code = "import sys; sys.path[:] = [folder for folder in sys.path if folder]; import torchvision"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return result.stderr if result.returncode else ""


def main() -> int:
    if sys.prefix == sys.base_prefix:
        print("torchvision remedy: run this with the Python of a virtual environment", file=sys.stderr)
        return 2
    module, pth = shim_files()
    error = import_error()
    if not error:
        print("torchvision imports: nothing to do")
        return 0
    if SYMPTOM not in error:
        print(f"import torchvision fails for another reason, left alone:\n{error}", file=sys.stderr)
        return 1
    module.write_text(SHIM, encoding="utf-8")
    pth.write_text(f"import {SHIM_NAME}\n", encoding="utf-8")
    error = import_error()
    if error:
        for path in (pth, module):
            path.unlink(missing_ok=True)
        print(f"the remedy did not help and was taken back:\n{error}", file=sys.stderr)
        return 1
    print(f"torchvision is a CUDA build beside a CPU torch: missing operators are declared by {module}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
