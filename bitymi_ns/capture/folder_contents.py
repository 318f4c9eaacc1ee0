"""Tell photographs from other pictures by the table of `kinds.py`, and name what is not read."""

import fnmatch
import os
import re
import shlex
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

import pillow_heif
from PIL import Image

from bitymi_ns.safe_reading import MOST_TEXT, open_regular
from bitymi_ns.trust import listed
from . import kinds
from .kinds import Kind

pillow_heif.register_heif_opener()

FORMATS_OF_PICTURES = (
    "JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "HEIF", "AVIF", "JPEG2000", "GIF", "PPM", "TGA"
)  # fmt: skip
"""Pillow's formats of photographs and masks; not EPS, a program that Ghostscript runs."""
HEAD = 1 << 20  # bytes searched for a mark
COMMENT = 1 << 10  # bytes searched for a picture's comment
HIDDEN, OTHER, EVALUATED = map(Kind, ("", "", ""), ("hidden", "pictures of another capture", "renders of ns-eval"))


def open_picture(file: Path) -> Image.Image:
    """Open a photograph or mask. Raises errors of Pillow and of `open_regular`."""
    open_regular(file).close()
    Image.init()  # earlier versions of Pillow have no AVIF
    return Image.open(file, formats=[name for name in FORMATS_OF_PICTURES if name in Image.OPEN])


def holds(path: Path, mark: bytes, most: int = HEAD) -> bool:
    """Test if a file's first bytes hold `mark`; False for unreadable files."""
    with suppress(OSError), open_regular(path) as file:
        return mark in file.read(min(most, os.fstat(file.fileno()).st_size))
    return False


@cache
def _pattern(names: str) -> re.Pattern[str]:
    """Compile the patterns of a row; groups are what NAME stands for."""
    return re.compile("|".join(fnmatch.translate(name).replace("NAME", "(.+)") for name in names.split()))


def kind_of(path: Path, rows: Iterable[Kind], beside: Collection[str] = ()) -> Kind | None:
    """Find the row of a file or folder by its name, the lower-case names `beside` it, and its content."""
    for row in rows:
        for form in (path.name.lower(), path.stem.lower()):
            if match := _pattern(row.names).match(form):
                name = next(filter(None, match.groups()), "")
                whose = [of.replace("NAME", name) for of in row.of.split()]
                there = any(of in beside or ("*" in of and fnmatch.filter(beside, of)) for of in whose)
                if (there or not whose) and (not row.mark or holds(path, row.mark.encode(), MOST_TEXT)):
                    return row
    return None


def is_picture(path: Path) -> bool:
    return path.suffix.lower() in kinds.PHOTOGRAPHS and not path.name.startswith(".") and path.is_file()


def look_in(folder: Path, among: Collection[Path] | None = None) -> Iterator[tuple[Path, Kind | None]]:
    """Walk a folder, or `among` its folders; yield photographs with None, and what is not searched or read."""
    for parent, below, names in os.walk(folder):
        where, left = Path(parent), _left_out(Path(parent), below)
        yield from ((where / name, kind) for name, kind in left.items() if kind is not HIDDEN)
        below[:] = sorted(set(below) - left.keys()) if among is None or where in among else []
        yield from _files(where, names)


def _files(folder: Path, names: Iterable[str]) -> Iterator[tuple[Path, Kind | None]]:
    """Yield the pictures and unread films of a folder, but no raw data beside its photograph."""
    paths = [folder / name for name in sorted(names) if not name.startswith(".")]
    pictures = [path for path in paths if is_picture(path)]
    stems = {path.stem.lower() for path in pictures}
    beside = stems | {path.name.lower() for path in pictures}
    for path in pictures:
        rendered = kinds.RENDERS if holds(path, kinds.RENDERED, COMMENT) else None
        yield path, kind_of(path, kinds.PICTURES, beside) or rendered
    for path in paths:
        if is_rendered_film(path):
            yield path, kinds.FILM
        elif path.stem.lower() not in stems and (unread := kind_of(path, kinds.UNREAD)):
            yield path, unread


def _left_out(parent: Path, below: Collection[str]) -> dict[str, Kind]:
    """Map subfolders that are not searched to kinds; captures beside photographs hold copies of these."""
    names, left, captures = {name.lower() for name in below}, {}, []
    for path in sorted(parent / name for name in below):
        kind = HIDDEN if path.name.startswith(".") else kind_of(path, kinds.FOLDERS, names) or result_in(path)
        if kind:
            left[path.name] = kind
        elif holds(path / "transforms.json", b'"transform_matrix"'):
            captures.append(path.name)
    if captures and (photographs_in(parent) or photographs_in(parent / "images")):
        left |= dict.fromkeys(captures, OTHER)
    return left


def photographs_in(folder: Path) -> list[Path]:
    """List the photographs of a folder; none if there is no such folder."""
    names = os.listdir(folder) if folder.is_dir() else ()
    return [path for path, kind in _files(folder, names) if kind is None]


def photo_folder(source: Path) -> Path:
    """Return the folder of a capture's photographs: itself, or its `images`."""
    images = source / "images"
    return images if images.is_dir() and not photographs_in(source) else source


def photographs_below(folder: Path) -> Iterator[Path]:
    return (path for path, kind in look_in(folder) if kind is None)


def folders_in(folder: Path) -> list[Path]:
    """List the subfolders that may hold photographs."""
    names = [path.name for path in folder.iterdir() if path.is_dir()]
    return sorted(folder / name for name in {*names} - _left_out(folder, names).keys())


def unreadable_in(folder: Path) -> str:
    """Say which folders in and below a folder cannot be listed, and why; empty = none."""
    errors: list[OSError] = []
    for _ in os.walk(folder, onerror=errors.append):
        pass
    names = listed([str(error.filename) for error in errors])
    return f" {names} cannot be read: {errors[0].strerror}." if errors else ""


def videos_in(folder: Path, rendered: bool = False) -> list[Path]:
    """List a folder's videos that are not hidden, or those of ns-render (`rendered`)."""
    names = (path for path in folder.iterdir() if path.suffix.lower() in kinds.VIDEOS and not path.name.startswith("."))
    return sorted(path for path in names if path.is_file() and is_rendered_film(path) is rendered)


def is_rendered_film(path: Path) -> bool:
    return path.suffix.lower() in kinds.VIDEOS and holds(path, kinds.RENDERED)


def passed_over(
    folder: Path,
    used: Collection[Path] | None = None,
    copies: str | None = None,
    masks: Collection[Path] = (),
    models: Mapping[Path, Path] | None = None,
) -> list[str]:
    """Describe the pictures in and below a folder that are not read, without `masks` and what lies beside them. Given
    the `used` files, also describe other photographs in their folders and one level below, and of which of the `models`
    they are. Folders whose names end in `copies` (as `images_2`) do not count."""
    among = None if used is None else {above for path in used for above in path.parents}
    groups: dict[tuple[Kind | None, Path, str], list[Path]] = defaultdict(list)
    described = []
    known = {*(used or ()), *masks}
    masked = {above for mask in masks for above in mask.parents}
    for path, kind in look_in(folder, among):
        if kind in kinds.OF_MASKS and (path if path.is_dir() else path.parent) in masked:
            continue
        if kind is not None and path.is_dir():
            count = sum(is_picture(file) and file not in known for file in path.rglob("*"))
            if count and not (copies and path.name.endswith(copies)):
                described.append(f"{path.relative_to(folder)} ({kind.what}: {count}{_use(kind)})")
        elif path not in known and (used is not None or kind is not None):
            groups[kind, path.parent, path.suffix.lower() if kind in kinds.UNREAD else ""].append(path)
    for (kind, parent, ending), paths in groups.items():
        if kind is None:
            own = (models or {}).get(parent) if all(path.parent != parent for path in known) else None
            whose = "nothing names" if own is None else f"belong to the model {own}"
            described.append(f"pictures of {parent} that {whose} ({listed([path.name for path in paths], most=2)})")
        elif ending:
            described.append(f"{len(paths)} {ending} of {parent} ({kind.what}, which is not read{_use(kind)})")
        else:
            first = listed([path.relative_to(folder) for path in paths], most=1)
            described.append(f"{first} ({kind.what}{_use(kind)})")
    return described


def _use(kind: Kind) -> str:
    return f"; {kind.use}" if kind.use else ""


def result_in(folder: Path) -> Kind | None:
    """Find the result that a folder's pictures are of."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:
        return None
    rows = [row for row in kinds.RESULTS if row is not kinds.RENDERS or folder.name in kinds.SPLITS]
    if row := next(filter(None, (kind_of(folder / name, rows) for name in names)), None):
        return row
    pictures = [name for name in names if name.endswith((".jpg", ".png"))]
    if pictures and re.fullmatch(r"eval_img_\d{4,}\.png", pictures[-1]) and pictures[0].startswith("eval_"):
        return EVALUATED
    rendered = pictures and all(holds(folder / pictures[i], kinds.RENDERED, COMMENT) for i in (0, -1))
    return kinds.RENDERS if rendered else None


def images_of(model: Path) -> list[Path]:
    """List the folders of a COLMAP model's pictures, the likeliest first."""
    path = os.path.abspath(model)
    matches = ((_pattern(row.names).match(path), row.what) for row in kinds.IMAGES_OF)
    folders = [what.replace("NAME", next(filter(None, match.groups()))) for match, what in matches if match]
    return [Path(os.path.normpath(model / os.path.relpath(folder, path))) for folder in folders]  # relative if it is


def refusal(folder: Path) -> str:
    """Say what to do with a bundle or a run; empty = it is neither."""
    what = result_in(folder) if folder.is_dir() else None
    give = "give the folder of its photographs"
    if what is kinds.BUNDLE:
        return f"{folder} is a bundle, not a capture: {give}. `bitymi view {folder}` shows the bundle."
    if what is kinds.RUN:
        return f"{folder} is a training run, not a capture: {give}; --load-dir {folder}/nerfstudio_models resumes it."
    return ""


def poses_in(folder: Path) -> tuple[str, ...]:
    """Describe the files of poses in a folder and its subfolders, and what converts them."""
    files: dict[Kind, list[Path]] = defaultdict(list)
    for where in (folder, *sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")):
        for path in sorted(where.iterdir()) if os.access(where, os.R_OK) and not result_in(where) else ():
            if path.is_file() and (kind := kind_of(path, kinds.POSES)):
                files[kind].append(path)
    described = []
    for kind, paths in files.items():
        names = listed([path.relative_to(folder) for path in paths], most=1)
        use = _use(kind)
        for word, path in (("FILE", paths[0]), ("IMAGES", photo_folder(folder)), ("FOLDER", folder)):
            use = use.replace(word, shlex.quote(str(path)))
        described.append(f"{names} ({kind.what}{use})")
    return tuple(described)
