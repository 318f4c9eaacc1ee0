"""Extras of a bundle for other programs: Gaussians, flat Gaussians, OpenUSD surflets, a textured mesh."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Literal

import torch

from bitymi_ns.bake.view_colors import centers_of
from bitymi_ns.bundle import Bundle, BundleError
from bitymi_ns.codec.pages import texel_alpha
from bitymi_ns.files import complete_folder, reserved, write_errors_as
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.visibility import visibility
from bitymi_ns.trust import check_replaceable
from .frame import to_capture, up_of
from .gaussians import Gaussians, gaussians_of, write_gaussians
from .glb import quads_glb, upright
from .quads import quads_of
from .recolor import recolored
from .surfel_colors import fit_colors, weighted_residuals
from .usd import check_usd, write_usd

Kind = Literal["gaussians", "surfels", "usd", "mesh"]
Frame = Literal["scene", "capture"]
FILES: dict[str, str] = {
    "gaussians": "gaussians.ply",
    "surfels": "surfels.ply",
    "usd": "surfels.usdc",
    "mesh": "mesh.glb",
}
DEFAULT: tuple[Kind, ...] = ("gaussians", "mesh")
SUMMARY = "extras.json"
SUFFIX = ".extras"  # of the folder beside a bundle
LEVEL = 0.15  # opacity at which the quads of a mesh end
SEEN_SIDE, COLORED_SIDE = 400, 800  # longer side in pixels of the views for visibility, and for a mesh's colours
COLORED_VIEWS = 64  # most training views that colour a mesh


@dataclass(frozen=True)
class ExtraFile:
    file: str
    bytes: int
    count: int  # Gaussians or quads
    note: str = ""  # origin of the positions, unless 0


def training_cameras(bundle: Bundle) -> Sequence[Camera]:
    """List the cameras of the training photographs; empty without cameras.json."""
    return [row.camera for row in bundle.cameras if not row.held_out]


def extras_folder(bundle: Path) -> Path:
    """Return the default folder of a bundle's extras, beside the bundle."""
    bundle = bundle.absolute()
    return bundle.with_name((bundle.stem if bundle.suffix == ".bitymi" else bundle.name) + SUFFIX)


def check_extras(kinds: Sequence[str], folder: Path, overwrite: bool) -> None:
    """Check the kinds and the output folder. Raises BundleError: a kind does not exist, or needs OpenUSD, which is not
    installed; or the folder exists without `overwrite`, or holds other files."""
    unknown = [kind for kind in kinds if kind not in FILES]
    if unknown or not kinds:
        what = f"there is no extra {unknown[0]!r}" if unknown else "no extra is asked for"
        raise BundleError(f"{what}: choose among {', '.join(FILES)}")
    if "usd" in kinds:
        check_usd()
    lost = _removed_by(kinds, folder)
    also = f", which also removes {', '.join(lost)} unless you ask for all kinds" if lost else ""
    made = [SUMMARY, *FILES.values()] if (folder / SUMMARY).is_file() else None
    check_replaceable(folder, "a folder of extras", made, overwrite, BundleError, f"--overwrite{also}")


def _removed_by(kinds: Sequence[str], folder: Path) -> list[str]:
    return [file for kind, file in FILES.items() if kind not in kinds and (folder / file).exists()]


def removal_line(kinds: Sequence[str], folder: Path) -> str:
    """Name the files of an earlier folder that writing these kinds removes."""
    lost = _removed_by(kinds, folder)
    return f"Removed {', '.join(lost)} of the earlier {folder}: ask for all kinds that you want." if lost else ""


def reserve_extras(kinds: Sequence[str], folder: Path, overwrite: bool) -> None:
    """Check that extras can be written to a folder. Raises BundleError."""
    with write_errors_as(folder, BundleError), reserved(folder, partial(check_extras, kinds, folder, overwrite)):
        pass


def write_extras(
    bundle: Bundle,
    folder: str | Path,
    kinds: Sequence[Kind] = DEFAULT,
    *,
    frame: Frame = "scene",
    cameras: Sequence[Camera] = (),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, ExtraFile]:
    """Write a folder, complete or not at all, with a file per kind and extras.json, which states them; return these by
    kind. `bundle`: on the CPU, texels decoded. `frame`: of the files: the scene's, or the capture's by
    bundle.json. `cameras`: of the training photographs, to fit colours to; without any, harmonics are fitted over the
    whole sphere, and a mesh keeps the surfels' colours. Raises BundleError: as `check_extras`; there is no surfel for a
    mesh; the transform to the capture's frame is no similarity; or the folder cannot be written."""
    folder = Path(folder)
    reserve_extras(kinds, folder, overwrite)
    to = to_capture(bundle.info.world) if frame == "capture" else None
    note = to.note if to is not None else ""
    scene, background = bundle.scene, torch.tensor(bundle.info.render.background)
    drawn = ([camera.within(SEEN_SIDE) for camera in cameras], scene.near, scene.weight_bound, progress)
    seen = visibility(scene.surfels, *drawn, texel_alpha(scene)).seen
    colors = fit_colors(scene, weighted_residuals(scene), seen, centers_of(cameras, scene.surfels["means"]))
    place = upright(up_of(bundle.info.world, to), None if to is None else to.origin)

    @cache
    def gaussians() -> Gaussians:
        made = gaussians_of(scene, colors.harmonics)
        return made if to is None else made.moved(to)

    def write(kind: Kind, path: Path) -> int:
        """Write a file; return its number of Gaussians or quads."""
        if kind == "mesh":
            quads = quads_of(scene, colors.color, LEVEL)
            if not len(quads):
                raise BundleError(f"no surfel of the bundle has an opacity above {LEVEL}: there is no mesh")
            chosen = [cameras[i].within(COLORED_SIDE) for i in spread(len(cameras), COLORED_VIEWS)]
            quads = recolored(quads, lambda camera: scene.render(camera, background).rgb, chosen, scene.near, progress)
            path.write_bytes(quads_glb(quads if to is None else quads.moved(to), place))
            return len(quads)
        if kind == "usd":
            write_usd(path, gaussians(), place)
        else:
            write_gaussians(path, gaussians(), [note] if note else [], flat=kind == "surfels")
        return len(gaussians())

    written: dict[str, ExtraFile] = {}
    replaceable = partial(check_extras, kinds, folder, overwrite)
    with write_errors_as(folder, BundleError, ". Nothing was left behind"), complete_folder(folder, replaceable) as new:
        for kind in dict.fromkeys(kinds):
            path = new / FILES[kind]
            count = write(kind, path)
            written[kind] = ExtraFile(path.name, path.stat().st_size, count, note)
        summary = {"frame": frame, "training_views": len(cameras)}
        summary |= {kind: asdict(file) for kind, file in written.items()}
        (new / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", "utf8")
    return written


def summary_line(written: ExtraFile) -> str:
    return f"{written.file}: {written.count:,}, {written.bytes / 1e6:.2f} MB" + (written.note and f"; {written.note}")
