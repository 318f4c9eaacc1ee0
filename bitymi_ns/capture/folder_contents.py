"""Tell photographs from other pictures of a folder: results of this package and of nerfstudio, wherever they lie, maps,
masks, and files of other programs that are not read."""

import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import pillow_heif
from PIL import Image

from bitymi_ns.safe_reading import MOST_TEXT, open_regular
from bitymi_ns.trust import listed

pillow_heif.register_heif_opener()  # for all users of Pillow

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jp2")
FORMATS_OF_PICTURES = (
    "JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "HEIF", "AVIF", "JPEG2000", "GIF", "PPM", "TGA"
)  # fmt: skip
"""Formats of photographs and masks by Pillow's names, whatever the file name; not EPS, a program that Ghostscript
runs."""
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp")
DYNAMIC_MASK = "dynamic_mask_"
"""Prefix of instant-ngp's masks beside photographs; black counts in them."""
RENDERED = b"rendered by bitymi-ns"
"""Comment in pictures and films of ns-render: frames are named as photographs are."""
BUNDLE, RUN = "pictures of a bundle", "pictures of a training run"
RESULT_FILES = {
    "bundle.json": (b'"bitymi-bundle"', BUNDLE),
    "config.yml": (b"!!python/object", RUN),
    "pictures.json": (b'"bitymi_pictures"', "pictures of `bitymi bench pictures`"),
    "transforms_eval.json": (b'[\n    {\n        "file_path"', "pictures beside cameras of ns-export"),
}
"""Files that mark a folder as a result: their content, and what the folder's pictures are."""
HEAD = 1 << 20  # bytes of a file that are searched for a mark
_RENDERS = "renders of ns-render"
_SPLIT_FOLDERS = {"train", "val", "test", "train+test"}
_MAPS = {"accumulation", "beta", "overdraw", "expected_depth"}
"""Folders that ns-render writes beside `rgb`, and captures lack; so are those that begin with raw- or gt-."""
RAW = "raw data of a camera"
UNREAD = {
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"), RAW),
    ".jxl": "JPEG XL", ".exr": "OpenEXR", ".hdr": "Radiance HDR", ".psd": "Photoshop",
}  # fmt: skip
"""Formats of unread images by extension."""
UNREAD_POSES = {
    "poses_bounds.npy": "LLFF", "cameras_sphere.npz": "NeuS", "cameras.npz": "IDR", "cameras.sfm": "Meshroom",
    "sfm_data.json": "OpenMVG", "reconstruction.json": "OpenSfM", "bundle.out": "Bundler", "bundle.rd.out": "Bundler",
}  # fmt: skip
"""Programs by their files of poses, in lower case."""
METASHAPE = b"<camera "  # in the XML file of cameras that Metashape exports under any name
OTHER_FOLDERS = {
    "mask": "masks", "masks": "masks", "depth": "depth maps", "depths": "depth maps", "depth_maps": "depth maps",
    "confidence": "confidence maps", "confidences": "confidence maps", "conf": "confidence maps",
    "normal": "normal maps", "normals": "normal maps", "normal_maps": "normal maps", "thumbnail": "thumbnails",
    "thumbnails": "thumbnails", "thumbs": "thumbnails", "sparse": "a model", "colmap": "a model", "dense": "a model",
    "stereo": "a model", "outputs": "outputs of training", "renders": "renders", "@eadir": "thumbnails",
    "segmentation": "segmentations", "segmentations": "segmentations", "semantic": "segmentations",
    "exports": "exports", "wandb": "pictures of a log", "planar_projections": "pictures made of panoramas",
}  # fmt: skip
"""Content of a capture's folders without photographs, by name in lower case."""
OTHER_FILES = {
    r"thumb(nail)?(_\d+)?": "a thumbnail", r"material_0|textured_output": "a texture", r"dynamic_mask_.*":
    "a mask of instant-ngp", r"depth_\d+|.*[._-]depth": "a depth map", r"conf_\d+": "a confidence map",
}  # fmt: skip
"""Pictures that are no photographs, by patterns of their names in lower case, without extension."""


def open_picture(file: Path) -> Image.Image:
    """Open a photograph or mask with Pillow; raises errors of Pillow's and of `open_regular`."""
    open_regular(file).close()
    Image.init()  # loads all formats; earlier versions of Pillow have no AVIF
    return Image.open(file, formats=[name for name in FORMATS_OF_PICTURES if name in Image.OPEN])


def is_photograph(path: Path) -> bool:
    """Test for an image that is not a depth map, mask or thumbnail."""
    return is_picture(path) and not _no_photograph(path)


def is_picture(path: Path) -> bool:
    """Test for a file with a photograph's extension that is not hidden."""
    return path.suffix.lower() in PHOTOGRAPHS and not path.name.startswith(".") and path.is_file()


def _no_photograph(path: Path) -> str:
    """Describe an image that is no photograph, by its name; empty for photographs."""
    matching = (what for pattern, what in OTHER_FILES.items() if re.fullmatch(pattern, path.stem.lower()))
    return next(matching, "")


def no_photographs(folder: Path, beside: Collection[str] = ()) -> str:
    """Describe the pictures of a folder without photographs, by its name, the names of folders `beside` it and the
    results in it; empty = it may hold photographs."""
    name = folder.name
    if name.startswith("."):
        return "hidden"
    if known := OTHER_FOLDERS.get(name.lower()):
        return known
    if f"corrected_{name}" in beside:
        return "raw copies of corrected pictures"
    original, _, factor = name.rpartition("_")
    if factor in ("2", "4", "8", "16") and original in beside:
        return "reduced copies"
    return result_in(folder)


def folders_in(folder: Path) -> list[Path]:
    """List the subfolders that may hold photographs."""
    names = [path.name for path in folder.iterdir() if path.is_dir()]
    return sorted(folder / name for name in names if not no_photographs(folder / name, names))


def has_photographs(folder: Path, below: bool = False) -> bool:
    """Test for photographs in a folder, or in or `below` it."""
    if not folder.is_dir():
        return False
    return any(True for _ in photographs_below(folder)) if below else any(map(is_photograph, folder.iterdir()))


def photographs_below(folder: Path) -> Iterator[Path]:
    """Yield the photographs in and below a folder, without hidden folders and those of other content."""
    for parent, below, names in os.walk(folder):
        below[:] = sorted(name for name, what in _skipped(Path(parent), below).items() if not what)
        yield from filter(is_photograph, (Path(parent, name) for name in names))


def unreadable_in(folder: Path) -> str:
    """Say which folders in and below a folder cannot be listed, and why, as a sentence; empty = none."""
    errors: list[OSError] = []
    for _ in os.walk(folder, onerror=errors.append):
        pass
    names = listed([str(error.filename) for error in errors])
    return f" {names} cannot be read: {errors[0].strerror}." if errors else ""


def videos_in(folder: Path, rendered: bool = False) -> list[Path]:
    """List a folder's videos that are not hidden; `rendered`: films of ns-render instead."""
    names = (path for path in folder.iterdir() if path.suffix.lower() in VIDEOS and not path.name.startswith("."))
    return sorted(path for path in names if path.is_file() and is_rendered_film(path) is rendered)


def _skipped(parent: Path, below: Collection[str]) -> dict[str, str]:
    """Map the names of a folder's subfolders to what they hold if they are not searched; empty = search them. Captures
    in subfolders beside photographs are skipped, because they hold copies of these."""
    found = {name: no_photographs(parent / name, below) for name in sorted(below)}
    marks = {name: parent / name / "transforms.json" for name, what in found.items() if not what}
    captures = [name for name, file in marks.items() if holds(file, b'"transform_matrix"')]
    if captures and (has_photographs(parent) or has_photographs(parent / "images")):
        found |= dict.fromkeys(captures, "pictures of another capture")
    return found


def passed_over(folder: Path, used: Collection[Path] | None = None, copies: str | None = None) -> list[str]:
    """Describe the pictures in and below a folder that are not read: those that `photographs_below` leaves out; given
    the `used` files, also other photographs in their folders and one level below. Folders whose names end in `copies`
    are left out: smaller copies, such as `images_2`."""
    found, holding = [], {above for path in used or () for above in path.parents}
    for parent, below, names in os.walk(folder):
        skipped = _skipped(Path(parent), below)
        for name, what in skipped.items():
            if copies is not None and name.endswith(copies):
                continue
            if what not in ("", "hidden") and (count := _pictures(Path(parent, name), used or ())):
                found.append(f"{Path(parent, name).relative_to(folder)} ({what}: {count})")
        searched = used is None or Path(parent) in holding  # a folder of captures may hold a whole disk
        below[:] = [name for name, what in skipped.items() if searched and not what]
        read, unnamed = [name for name in names if is_picture(Path(parent, name))], []
        alike: dict[str, list[Path]] = defaultdict(list)
        for path in (Path(parent, name) for name in sorted(read)):
            if used is not None and path in used:
                continue
            if what := _no_photograph(path):
                alike[what].append(path.relative_to(folder))
            elif used is not None:
                unnamed.append(path.name)
        for what, paths in alike.items():
            found.append(f"{listed(paths, most=1)} ({what})")
        if unnamed:
            found.append(f"pictures of {parent} that nothing names ({listed(unnamed, most=2)})")
        films = videos_in(Path(parent), rendered=True)
        found += [f"{film.relative_to(folder)} (a film of ns-render)" for film in films]
        for ending, count in pictures_among(names, read).items():
            found.append(f"{count} {ending} of {parent} ({UNREAD[ending]}, which is not read)")
    return found


def _pictures(folder: Path, used: Collection[Path]) -> int:
    """Count the unused pictures in and below a folder."""
    walked = (Path(parent, name) for parent, _, names in os.walk(folder) for name in names)
    return sum(is_picture(path) and path not in used for path in walked)


def result_in(folder: Path) -> str:
    """Describe the result that a folder's pictures are of, by its files; empty = none."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:  # unreadable folders are allowed
        return ""
    for name, (mark, what) in RESULT_FILES.items():
        if name in names and holds(folder / name, mark):
            return what
    if folder.name in _SPLIT_FOLDERS and any(name in _MAPS or name.startswith(("raw-", "gt-")) for name in names):
        return _RENDERS
    pictures = [name for name in names if name.endswith((".jpg", ".png"))]
    if not pictures:
        return ""
    if re.fullmatch(r"eval_img_\d{4,}\.png", pictures[-1]) and all(name.startswith("eval_") for name in pictures):
        return "renders of ns-eval"
    return _RENDERS if holds(folder / pictures[0], RENDERED, 1 << 10) else ""


def refusal(folder: Path) -> str:
    """Say why a folder cannot be trained on, and what to do, if it is a bundle or a run; empty = it can."""
    what = result_in(folder) if folder.is_dir() else ""
    if what == BUNDLE:
        bundle = f"{folder} is a bundle, not a capture: give the folder of its photographs."
        return f"{bundle} `bitymi view {folder}` shows the bundle."
    if what == RUN:
        advice = f"give the folder of its photographs, and --load-dir {folder}/nerfstudio_models to go on with the run."
        return f"{folder} is a training run, not a capture: {advice}"
    return ""


def is_rendered_film(path: Path) -> bool:
    """Test for a film that ns-render wrote."""
    return holds(path, RENDERED)


def holds(path: Path, mark: bytes, most: int = HEAD) -> bool:
    """Test if the first bytes of a file hold `mark`; False for unreadable files."""
    try:
        with open_regular(path) as file:
            return mark in file.read(min(most, os.fstat(file.fileno()).st_size))
    except OSError:
        return False


def poses_in(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield a folder's files of poses, each with its program."""
    for path in sorted(path for path in folder.iterdir() if path.is_file()):
        if path.name.lower() in UNREAD_POSES:
            yield path, UNREAD_POSES[path.name.lower()]
        elif path.suffix.lower() == ".xml" and holds(path, METASHAPE, MOST_TEXT):
            yield path, "Metashape"


def pictures_among(names: Sequence[str], read: Sequence[str]) -> dict[str, int]:
    """Count a folder's unread images by extension, without raw data beside a photograph of the same name in `read`."""
    stems = {Path(name).stem.lower() for name in read}
    endings = [path.suffix.lower() for path in map(Path, names) if path.stem.lower() not in stems]
    return {ending: endings.count(ending) for ending in UNREAD if ending in endings}
