"""gsplat for the sections of gpu.py and for gpu_peers.py, on the scenes of `harness.trained_like`. Optional: a note
says where it cannot be imported.

It gets the same centres, orientations and opacities, SH of degree 3, and the scales at which its Gaussians have the
curvature of the Beta kernels at their centres. Where the version has an inference renderer
(`gsplat.experimental.GaussianInferenceRenderer`, of scenes packed to half precision), that is timed too.
"""

from collections.abc import Callable
from typing import Any

import torch
from common import number, say, table
from harness import Options, attempt, milliseconds, trained_like
from torch import Tensor

from bitymi_ns.scene.camera import Camera

TIMES = (1, 3, 10)  # Gaussians per surfel of ours: as many, and what equal quality takes at least and at most
NOTE = (
    "gsplat gets the same centres, orientations and opacities, the scales at which its Gaussians have the curvature of "
    "the Beta kernels at their centres, and SH of degree 3."
)


def load() -> tuple[Any, str]:
    """Import gsplat: the module and, where it is missing, the reason."""
    try:
        import gsplat
        import gsplat.cuda._backend  # compiles the kernels where that was not done
    except (ImportError, RuntimeError, OSError) as error:
        return None, f"gsplat cannot be timed here: {error}"
    return gsplat, ""


def gaussians(n: int, width: int, height: int, device: torch.device) -> tuple[dict[str, Tensor], Camera]:
    """means, quats (unit), scales, opacities, sh of n Gaussians, and the camera."""
    scene, camera = trained_like(n, width, height, device, view_color="sh", texture=False)
    q = {name: value.detach() for name, value in scene.surfels.items()}
    beta = 4 * torch.sigmoid(q["beta_raw"])
    scales = q["log_scales"].exp() * (3 / (2 * beta).sqrt())[:, None]  # the kernel's curvature at its centre
    return {
        "means": q["means"].contiguous(),
        "quats": torch.nn.functional.normalize(q["quats"], dim=-1).contiguous(),
        "scales": torch.cat([scales, scales.amin(dim=1, keepdim=True)], dim=1).contiguous(),
        "opacities": torch.sigmoid(q["opacity_logits"]).contiguous(),
        "sh": torch.cat([q["sh_dc"][:, None], q["sh_rest"]], dim=1).contiguous(),
    }, camera


def frames(options: Options, ours: dict[tuple[int, int, int], float]) -> str:
    """Frames with as many Gaussians as our scenes have surfels, and with more.

    Args:
        options: how to time.
        ours: (surfels, width, height) -> milliseconds of our frame.
    """
    if options.device.type != "cuda":
        return ""
    gsplat, why = load()
    if gsplat is None:
        return f"\n\n{why}"
    rows = []
    for (n, width, height), mine in ours.items():
        for times in TIMES:
            g, camera = gaussians(times * n, width, height, options.device)
            for name, make in RENDERERS.items():
                what = f"{name}, {times * n:,} Gaussians, {width} x {height}"

                def measure(make: Callable = make, g: dict[str, Tensor] = g, camera: Camera = camera) -> float:
                    return milliseconds(make(gsplat, g)(camera), options)

                ms = attempt(what, measure)
                if ms is None:
                    continue
                say(f"{what}: {ms:.3f} ms")
                row = [name, f"{times * n:,}", f"{width} x {height}", number(ms, 3), number(mine, 3)]
                rows.append([*row, number(ms / mine, 2)])
            del g
            torch.cuda.empty_cache()
    header = ("gsplat's", "Gaussians", "size", "ms", "ours, packed graph ms", "gsplat / ours")
    version = getattr(gsplat, "__version__", "")
    return f"\n\ngsplat {version}. {NOTE} As many as our scene has surfels, and 3 and 10 times as many.\n\n" + table(
        header, rows
    )


Frames = Callable[[Camera], Callable[[], Tensor]]  # makes for a camera a function that draws its view, [H, W, 3]


def rasterized(kind: str) -> Callable[[Any, dict[str, Tensor]], Frames]:
    """Frames by a function of gsplat, of the Gaussians as in `gaussians`."""

    def of(gsplat: Any, g: dict[str, Tensor]) -> Frames:
        function = getattr(gsplat, kind)

        def make(camera: Camera) -> Callable[[], Tensor]:
            view = (camera.viewmat[None], camera.K[None], camera.width, camera.height)

            @torch.no_grad()
            def draw() -> Tensor:
                return function(*g.values(), *view, sh_degree=3, packed=False)[0][0]

            return draw

        return make

    return of


def inferred(compression: str) -> Callable[[Any, dict[str, Tensor]], Frames]:
    """Frames by the inference renderer, of a scene that is packed beforehand."""

    def of(gsplat: Any, g: dict[str, Tensor]) -> Frames:
        from gsplat.experimental import GaussianInferenceRenderer, GaussianInferenceScene

        scene = GaussianInferenceScene.from_gaussian_tensors(
            *g.values(), sh_degree=3, sh_compression=compression, id=f"{compression}{len(g['means'])}"
        )
        renderer = GaussianInferenceRenderer(scene)

        def make(camera: Camera) -> Callable[[], Tensor]:
            view = {"viewmat": camera.viewmat, "K": camera.K, "width": camera.width, "height": camera.height}

            @torch.inference_mode()
            def draw() -> Tensor:
                return renderer.render(**view).frame[0, ..., :3]

            return draw

        return make

    return of


RENDERERS: dict[str, Callable[[Any, dict[str, Tensor]], Frames]] = {
    "rasterization": rasterized("rasterization"),
    "rasterization_2dgs": rasterized("rasterization_2dgs"),
    "inference renderer": inferred("none"),
    "inference renderer, SH in 16 bytes": inferred("16b"),
}


def steps(
    n: int, width: int, height: int, loss: Callable[[Tensor], Tensor], make_step: Callable, device: torch.device
) -> list[tuple[str, Callable[[], object], int | None]]:
    """Training steps: name, step, pairs of Gaussian and tile.

    Args:
        n, width, height: of the scene.
        loss: of an image [height, width, 3].
        make_step: makes a step of a function that renders, the loss and the parameters.
        device: a card, else there are none.
    """
    if device.type != "cuda":
        return []
    gsplat, why = load()
    if gsplat is None:
        say(why)
        return []
    g, camera = gaussians(n, width, height, device)
    view = (camera.viewmat[None], camera.K[None], width, height)
    values = {**g, "scales": g["scales"].log(), "opacities": torch.logit(g["opacities"].clamp(1e-6, 1 - 1e-6))}
    cases: list[tuple[str, Callable[[], object], int | None]] = []
    for name, function in (("2DGS", gsplat.rasterization_2dgs), ("3DGS", gsplat.rasterization)):
        leaves = {key: value.clone().requires_grad_() for key, value in values.items()}

        def call(leaves: dict[str, Tensor] = leaves, function: Callable = function) -> tuple:
            shape = (leaves["means"], leaves["quats"], leaves["scales"].exp(), torch.sigmoid(leaves["opacities"]))
            return function(*shape, leaves["sh"], *view, sh_degree=3, packed=False)

        pairs = attempt(f"gsplat {name}", lambda call=call: int(call()[-1]["flatten_ids"].shape[0]))
        if pairs is not None:
            step = make_step(lambda call=call: call()[0][0], loss, list(leaves.values()))
            cases.append((f"gsplat {name} {getattr(gsplat, '__version__', '')}, SH 3", step, pairs))
    return cases
