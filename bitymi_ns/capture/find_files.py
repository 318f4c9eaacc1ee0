"""Find a capture's files by names that may be of another machine."""

import difflib
import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from bitymi_ns.trust import leads_inside, listed, told_apart
from .folder_contents import images_of, passed_over, result_in
from .kinds import PHOTOGRAPHS
from .recognise import Found, models_in
from .types import MAP_FILES, MapFiles, Photograph, fail, say, warn

Parts = tuple[str, ...]  # folders and file of a name
_DRIVE = re.compile(r"^[A-Za-z]:")


def folded(name: str) -> Parts:
    """Remove what differs between machines: separators, case, Unicode form, `.` and a drive."""
    portable = _DRIVE.sub("", name).replace("\\", "/")
    plain = unicodedata.normalize("NFC", os.path.normpath(portable)).casefold()
    return tuple(part for part in plain.split("/") if part not in ("", "."))


def without_extension(parts: Parts) -> Parts:
    stem, ending = os.path.splitext(parts[-1])
    return (*parts[:-1], stem if ending in PHOTOGRAPHS else parts[-1])


@dataclass
class FileFinder:
    """Finder of files by the exact name, else by `folded` names without leading folders, else without extension, if
    unique."""

    folder: Path  # to which names are relative
    outside: bool = False  # allow names that lead out of it
    extensions: tuple[str, ...] = PHOTOGRAPHS  # of the files
    deep: bool = True  # search subfolders, too

    def find(self, name: str) -> Path | None:
        """Find a file; None = none, or several."""
        for exact in (name, name.replace("\\", "/")):
            if (self.outside or leads_inside(exact)) and os.path.isfile(self.folder / exact):
                return self.folder / exact
        parts = folded(name)
        if not parts:
            return None
        tries = (parts, self._whole), (parts, self._stems), (without_extension(parts), self._stems)
        return next(filter(None, (self._match(*each) for each in tries)), None)

    def find_all(self, names: Sequence[str]) -> list[Path | None]:
        """Find several files; one that fits several names is that of its exact name, or of none."""
        files = [self.find(name) for name in names]
        exact = [path if self.folder / name == path else None for name, path in zip(names, files, strict=True)]
        users, sure = Counter(files), Counter(exact)
        return [path if users[path] == 1 or (same and sure[path] == 1) else None
                for path, same in zip(files, exact, strict=True)]  # fmt: skip

    def missing(self, name: str) -> Path:
        """Return a path to show for a missing file."""
        if self.outside or leads_inside(name):
            return self.folder / name
        parts = PurePosixPath(name.replace("\\", "/").replace("\0", "_")).parts
        return self.folder.joinpath(*("_" if part in ("/", "//", "..") else part for part in parts))

    def ambiguous(self, name: str) -> list[str]:
        """List the files that a name may mean apart from its extension, if several."""
        files = self._stems.get(without_extension(folded(name)), [])
        return [path.relative_to(self.folder).as_posix() for path in files] if len(files) > 1 else []

    def nearest(self, name: str, taken: Iterable[str] = ()) -> str:
        """Describe a file of a similar name that is not `taken`, as "but there is ..."; empty = none."""
        wanted, used = folded(name)[-1:], {folded(path)[-1:] for path in taken}
        last = {parts[-1]: files[0] for parts, files in self._whole.items() if parts[-1:] not in used}
        near = difflib.get_close_matches(wanted[0] if wanted else "", last, n=1, cutoff=0.8)
        if not near:
            return ""
        there = last[near[0]].relative_to(self.folder).as_posix()
        same = there.isascii() and name.isascii()
        return f"but there is {there}" if same else f"but there is {there}, {ascii(there)}, instead of {ascii(name)}"

    def _match(self, parts: Parts, table: dict[Parts, list[Path]]) -> Path | None:
        for start in range(len(parts)):  # without its leading folders
            files = table.get(parts[start:], [])
            if files:
                return files[0] if len(files) == 1 else None
        deeper = [files for tail, files in table.items() if tail[-len(parts) :] == parts]
        return deeper[0][0] if len(deeper) == 1 and len(deeper[0]) == 1 else None

    @cached_property
    def _whole(self) -> dict[Parts, list[Path]]:
        table, paths = defaultdict(list), []
        for folder, below, files in os.walk(self.folder):
            if not self.deep:
                below.clear()
            below[:] = [name for name in below if not name.startswith(".") and not result_in(Path(folder, name))]
            paths += [Path(folder, name) for name in files if name.lower().endswith(self.extensions)]
        for path in sorted(paths):
            table[folded(path.relative_to(self.folder).as_posix())].append(path)
        return dict(table)

    @cached_property
    def _stems(self) -> dict[Parts, list[Path]]:
        table: dict[Parts, list[Path]] = defaultdict(list)
        for parts, files in self._whole.items():
            table[without_extension(parts)] += files
        return dict(table)


def check_photographs_exist(source: Path, files: Iterable[Path]) -> None:
    """Fail if photographs that `source` names are missing; show similar names."""
    names = list(dict.fromkeys(files))
    missing = [file for file in names if not os.path.isfile(file)]  # Path.is_file raises if a path is too long
    if not missing:
        return
    shown = "\n  ".join(f"{file}{_hint(source.parent, file, names)}" for file in missing[:3])
    advice = f"Copy them there, correct the names or remove the frames.{_smaller_copies(missing)}"
    fail(f"{len(missing)} of {len(names)} photographs of {source} are missing:\n  {shown}\n{advice}")


def _smaller_copies(files: Iterable[Path]) -> str:
    """Say how to use copies of missing photographs in a folder such as `images_2`; empty = there are none."""
    for file in files:
        for factor in (2, 4, 8, 16):
            folder = Path(f"{os.path.abspath(file.parent)}_{factor}")
            if os.path.isfile(folder / file.name):
                return f" Or use their copies in {folder}: `bitymi-data --downscale-factor {factor}`."
    return ""


def name_unused(found: Found, used: Iterable[Path | None], masks: Iterable[Path | None], downscale: int | None) -> None:
    """Report pictures that are neither `used` nor `masks` nor copies smaller by `downscale`."""
    named, masked = ({Path(os.path.normpath(path)) for path in paths if path is not None} for paths in (used, masks))
    folder = Path(os.path.normpath(found.folder))
    copies = None if downscale is None else f"_{downscale}"
    models = {images: model for model in models_in(folder) for images in images_of(folder / model)}
    if left := passed_over(folder, named, copies, masked, models):
        say(f"Not taken for photographs in {found.folder}: {listed(left, most=12)}.")


def _hint(folder: Path, file: Path, named: Sequence[Path]) -> str:
    if os.path.islink(file):
        return " (a link to nothing)"
    if os.path.exists(file):
        return " (not a file)"
    there = file.parent if os.path.isdir(file.parent) else folder
    finder = FileFinder(there, deep=there.is_relative_to(folder))  # elsewhere may be a whole disk
    near = finder.nearest(file.name, [path.name for path in named])
    return f" ({near})" if near else ""


def report_renamed(source: str, names: Sequence[str], files: Sequence[Path], folder: Path) -> None:
    """Report files with other names than stated, apart from a missing extension and separators."""

    def is_usual(name: str, file: Path) -> bool:
        plain = Path(os.path.normpath(folder / name.replace("\\", "/")))
        return os.path.normpath(file) in (str(plain), f"{plain}{file.suffix}")

    renamed = [f"{file.relative_to(folder).as_posix()} for {name}" for name, file in zip(names, files, strict=True)
               if file.is_relative_to(folder) and not is_usual(name, file)]  # fmt: skip
    if renamed:
        say(f"{source}: {len(renamed)} of {len(names)} photographs have other names: {listed(renamed)}.")


def report_files(path: Path, names: Sequence[str], files: Sequence[Path], masks: Sequence[Path | None]) -> None:
    """Report files with other names than stated, and warn of those outside the folder, which results will show."""
    report_renamed(str(path), names, files, path.parent)
    folder = os.path.normpath(path.parent)
    pictures = dict.fromkeys(Path(os.path.normpath(file)) for file in (*files, *masks) if file is not None)
    outside = [file for file in pictures if not file.is_relative_to(folder) and os.path.isfile(file)]
    if outside:
        warn(f"{path} names pictures outside of its folder, which are read there: {listed(outside)}.")


def find_photographs(path: Path, names: Sequence[str], need_photos: bool) -> list[Path]:
    """Find the photographs that a file names; missing ones have the stated path. Fail if a name fits several files."""
    folder = path.parent
    finder = FileFinder(folder, outside=True)
    files = finder.find_all(names)
    if need_photos and None in files and (folder / "images").is_dir():
        taken = set(files)
        images = FileFinder(folder / "images").find_all(names)
        files = [file or (None if image in taken else image) for file, image in zip(files, images, strict=True)]
    for i, (name, file) in enumerate(zip(names, files, strict=True)):
        ambiguous = finder.ambiguous(name) if need_photos and file is None else []
        if ambiguous:
            fail(f"{path}: frame {i} is of {name}, but there are {listed(ambiguous)}. Write the right one's ending.")
    return [Path(os.path.normpath(file or folder / name)) for name, file in zip(names, files, strict=True)]


def find_masks(
    folder: Path, names: Sequence[str | None], photographs: Sequence[Path], need_photos: bool
) -> list[Path | None]:
    """Find masks, which photographs may share; missing ones have the stated path."""
    finder = FileFinder(folder, outside=True)
    taken = {None, *photographs}
    files = {name: finder.find(name) if need_photos else None for name in dict.fromkeys(names) if name is not None}
    return [None if name is None else folder / name if files[name] in taken else files[name] for name in names]


def find_maps(path: Path, frames: Sequence[dict[str, Any]], need_photos: bool) -> list[MapFiles]:
    """Find depth and normals; warn of missing files."""
    finder = FileFinder(path.parent, outside=True, extensions=MAP_FILES)
    files: dict[str, list[Path | None]] = {}
    for key in ("depth_file_path", "normal_file_path"):
        names = [frame.get(key) for frame in frames]
        files[key] = [None if name is None else finder.find(name) for name in names]
        lacking = [name for name, file in zip(names, files[key], strict=True) if name is not None and file is None]
        if lacking and need_photos:
            warn(f"{path}: {len(lacking)} files of {key} are missing, and not used: {listed(lacking)}.")
    return [MapFiles(depth, normal=normal) for depth, normal in zip(*files.values(), strict=True)]


def find_named(names: Sequence[Path], wanted: Sequence[str], source: str, any_folder: bool = False) -> list[int]:
    """Find photographs by names that may differ in case, Unicode form, extension and (`any_folder`) leading folders."""
    forms: list[Callable[[str], Parts]] = [
        lambda name: PurePath(name.replace("\\", "/")).parts,
        folded,
        lambda name: without_extension(folded(name) or ("",)),
    ]
    tables: list[dict[Parts, list[int]]] = [defaultdict(list) for _ in forms]  # by ends of names
    for form, table in zip(forms, tables, strict=True):
        for i, parts in enumerate(form(str(name)) for name in names):
            for start in range(len(parts)):
                table[parts[start:]].append(i)
    unknown, indices = [], []
    for name in wanted:
        tails = ((table, form(name)) for form, table in zip(forms, tables, strict=True))
        ends = ((table, parts[k:]) for table, parts in tails for k in range(len(parts) if any_folder else 1))
        fitting = next(filter(None, (table.get(parts) for table, parts in ends)), [])
        if len(fitting) > 1:
            several = f"{len(fitting)} photographs, {listed([names[i] for i in fitting])}"
            fail(f"{source}: {name} is the name of {several}. Give its folder, too.")
        indices += fitting
        unknown += [] if fitting else [name]
    if unknown:
        which = f"{listed(unknown)}. Its photographs are {listed(told_apart(names))}."
        fail(f"{source}: {len(unknown)} of {len(wanted)} names are of no photograph of the capture: {which}")
    return indices


def downscaled(photographs: list[Photograph], folder: Path, downscale: int) -> list[Photograph]:
    """Replace photographs by copies in `images_2` beside `images`, if any; these may lack subfolders."""

    def copies(file: Path) -> list[Path]:
        inside = file.relative_to(folder).parts if file.is_relative_to(folder) else (file.parent.name, file.name)
        flat = folder / f"images_{downscale}" / file.name
        if len(inside) == 1:
            return [flat]
        return [folder.joinpath(f"{inside[0]}_{downscale}", *inside[1:]), *([flat] if inside[0] == "images" else [])]

    def mask_copy(mask: Path | None) -> Path | None:
        copy = None if mask is None else folder / f"masks_{downscale}" / mask.name
        return copy if copy is not None and os.path.isfile(copy) else mask

    files = [photograph.file for photograph in photographs]
    small = [next(filter(os.path.isfile, copies(file)), copies(file)[0]) for file in files]
    if not any(map(os.path.isfile, small)):
        return photographs
    if len(set(small)) < len(set(files)):
        uses = Counter(small)
        twins = sorted({file.relative_to(folder).as_posix() for file, copy in zip(files, small, strict=True)
                        if uses[copy] > 1})  # fmt: skip
        where = f"have the same names in different folders, of which {small[0].parent} can hold one"
        fail(f"{listed(twins)} {where}. Use `bitymi-data --downscale-factor 1`, or give them different names.")
    return [replace(photograph, file=copy, mask=mask_copy(photograph.mask), downscaled=True)
            for photograph, copy in zip(photographs, small, strict=True)]  # fmt: skip
