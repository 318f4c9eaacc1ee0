"""Find camera poses of photographs or of a video's frames by structure from motion."""

import json
import os
import statistics
import time
import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields, replace
from pathlib import Path

from pydantic import TypeAdapter

from bitymi_ns.files import Tell, complete_folder, write_errors_as, write_file
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.safe_reading import read_json
from bitymi_ns.trust import listed
from . import pycolmap, sfm_photos, types
from .cache import content_key, emptied, replace_stale, work_folder
from .colmap_model import write_model
from .folder_contents import passed_over, photo_folder, refusal, unreadable_in, videos_in
from .frame import local_positions, move_to_world, write_frame
from .kinds import FILM, VIDEOS
from .masks import find_masks, mask_folder, write_colmap_masks
from .recognise import is_model
from .sfm import process
from .sfm.job import MODEL, CameraGroup, Job
from .sfm.model_checks import SHOOT
from .sfm_photos import Photo
from .sfm_report import write_report
from .types import SPHERICAL_MODEL, ColmapCamera, FoundPoses, SfmOptions, fail, is_full_sphere
from .video import NO_MOTION, extract_frames

GUESSED_FOCAL = 1.2  # COLMAP's own, in longer sides
TELLING = 0.25  # least share of what looks like 360-degree pictures for all to be some
LEAST = 3  # fewest photographs
SPARSE = Path("sparse/0")  # the model's path in a result


def find_poses(
    source: Path,
    options: SfmOptions | None = None,
    progress: Progress | None = None,
    warn: Tell = warnings.warn,
    capture: Path | None = None,
) -> FoundPoses:
    """Find camera poses of photographs (of a folder, or its `images`) or of a video's frames; cache them, and continue
    an interrupted run. `warn` receives what is left out; `capture`: folder that may hold masks, too. Raises
    CaptureError: there are no poses; says what to photograph differently."""
    options = options or SfmOptions()
    tell = progress or no_progress
    source, folder, names = _photographs_in(Path(source))
    sfm_photos.check_names(folder, names)
    masks: dict[str, Path] = {}
    if options.use_masks and names:
        base, within = photo_folder(source), capture or source
        where = mask_folder(base, within, options.masks) or mask_folder(folder, within)
        if where is not None and (below := where / folder.relative_to(base)).is_dir():
            where = below
        masks, _ = find_masks(names, folder, where, options.masks is not None)
        if not masks and where is not None:
            advice = "name them as the photographs, photo.png for photo.jpg, or leave them out"
            fail(f"no mask in {where} belongs to a photograph: {advice} (--use-masks False)")
    if source.is_dir():
        left = passed_over(source, masks=masks.values())
    else:
        left = [f"{film.name} ({FILM.what})" for film in videos_in(source.parent, rendered=True)]
    if left:
        warn(f"Not taken for photographs in {source}: {listed(left, most=12)}.")
    inputs = [(name, folder / name) for name in names] or [(source.name, source)]
    inputs += [(f"masks/{name}", path) for name, path in masks.items()]
    settings = {**asdict(options), "masks": bool(masks)}
    del settings["use_masks"]
    with work_folder(folder, content_key(inputs, settings), warn) as work:
        poses = _finished(work, folder)
        if poses is None:
            with write_errors_as(work, types.CaptureError):
                poses = _find(source, folder, names, masks, options, warn, work, tell)
                replace_stale(work, folder, content_key(inputs, "contents"))
        return poses


def _photographs_in(source: Path) -> tuple[Path, Path, list[str]]:
    """Return the source, its folder of photographs and their names (none of a video)."""
    if source.suffix.lower() in VIDEOS and source.is_file():
        return source, source, []
    if not source.exists():
        fail(f"{source} does not exist: name a folder of photographs, or a video")
    if why := refusal(source):
        fail(why)
    if not source.is_dir():
        fail(f"{source} is neither a folder of photographs nor a video ({', '.join(VIDEOS)})")
    folder = photo_folder(source)
    names = sfm_photos.find_photos(folder)
    videos = videos_in(source)
    if not names and len(videos) == 1:
        return videos[0], videos[0], []
    if len(names) < LEAST:
        also = f" Of its {len(videos)} videos, name one." if videos and not names else ""
        needs = f"camera poses need at least {LEAST}, and a scene 20 to 200. {SHOOT}"
        fail(f"{folder} holds {len(names) or 'no'} photographs: {needs}.{unreadable_in(source) or also}")
    below = os.path.commonpath([f"./{os.path.dirname(name)}" for name in names])  # as if their common folder were given
    return source, folder / below, [os.path.relpath(name, below) for name in names]


def _finished(work: Path, folder: Path) -> FoundPoses | None:
    """Read an earlier run's poses by poses.json, which marks complete results; None = none, or damaged."""
    result = work / "result"
    with suppress(OSError, ValueError, LookupError, AttributeError, TypeError):
        kept = read_json(result / "poses.json")
        made = kept.pop("made")  # its photographs are copies or frames in the work folder
        images = work / sfm_photos.IMAGES if made else Path(os.path.abspath(folder))
        values = {**kept, "model": result / SPARSE, "images": images, "report": result}
        poses = TypeAdapter(FoundPoses).validate_python(values)
        whole = not made or (images.is_dir() and all(path.exists() for path in images.rglob("*")))
        return poses if whole and is_model(result / SPARSE) else None
    return None


def _find(
    source: Path,
    folder: Path,
    names: list[str],
    masks: Mapping[str, Path],
    options: SfmOptions,
    warn: Tell,
    work: Path,
    tell: Progress,
) -> FoundPoses:
    begun = time.monotonic()
    seconds: dict[str, float] = {}
    if video := not names:
        folder = extract_frames(source, work, options.frames, tell)
        names = sfm_photos.find_photos(folder)
        seconds["taking frames"] = time.monotonic() - begun
    read = time.monotonic()
    photos, left_out = sfm_photos.read_photos(folder, names, tell)
    photos = _with_panoramas(folder, photos, left_out, options.camera_model, warn)
    twins = sfm_photos.duplicates(photos)
    left_out |= {name: f"the same as {twin}" for name, twin in twins.items()}
    photos = [photo for photo in photos if photo.name not in twins]
    seconds["reading photographs"] = time.monotonic() - read
    if len(photos) < LEAST:
        alike = len(twins) >= len(left_out) - len(twins)
        if video and alike:
            fail(f"{source} {NO_MOTION}")
        reasons = listed([f"{name}: {why}" for name, why in left_out.items()])
        whose = f"frames of {source}" if video else f"photographs in {folder}"
        use, then = ("differ", "take some from different places") if alike else ("can be used", "copy them again")
        fail(f"of the {whose}, only {len(photos)} {use} ({reasons}): {then}")
    photos = ordered(photos)
    started = time.monotonic()
    images, used = sfm_photos.upright_photos(photos, folder, work, tell)
    job = make_job(photos, images, used, masks, options, work, sequence=video)
    seconds["preparing"] = time.monotonic() - started
    result = process.run(job, source, tell)
    left_out |= result.pop("left_out")
    notes = {name: "blurred: much less fine detail than the others" for name in sfm_photos.blurred(photos)}
    notes |= {photo.name: f"focal length in EXIF not used: {photo.exif.doubt}" for photo in photos if photo.exif.doubt}
    seconds |= result.pop("seconds")
    seconds["all"] = time.monotonic() - begun
    values = {"source": str(source), "given": len(names), "left_out": left_out, "notes": notes, "seconds": seconds}
    return _write(work, images, {**values, **result}, photos, job)


def _with_panoramas(source: Path, photos: list[Photo], left_out: dict[str, str], model: str, warn: Tell) -> list[Photo]:
    """Decide of the photographs of a size in a folder together if they are 360-degree pictures: by the camera `model`,
    or as a quarter of them or most of their edges tell. Leave out panoramas of another shape; fail if most are."""
    groups: dict[tuple[str, int, int], list[Photo]] = defaultdict(list)
    for photo in photos:
        groups[os.path.dirname(photo.name), photo.width, photo.height].append(photo)
    decided = {}
    for key, alike in groups.items():
        told = [photo for photo in alike if photo.panorama]
        closed = len(alike) >= LEAST and statistics.median(photo.seam for photo in alike) > sfm_photos.ALIKE
        decided[key] = model == SPHERICAL_MODEL or (
            model == "auto" and (closed or len(told) >= TELLING * len(alike) > 0.0)
        )
        if model == "auto" and len(told) not in (0, len(alike)):
            kind = "360-degree pictures" if decided[key] else "photographs"
            other = "SIMPLE_RADIAL" if decided[key] else SPHERICAL_MODEL
            which = f"{len(told)} of {len(alike)} photographs of {key[1]} x {key[2]} pixels in {source / key[0]}"
            advice = f"If they are not: `bitymi-data --sfm.camera-model {other}`."
            warn(f"{which} look like 360-degree pictures: all are read as {kind}. {advice}")
    photos = [replace(p, panorama=decided[os.path.dirname(p.name), p.width, p.height]) for p in photos]
    partial = [photo.name for photo in photos if photo.panorama and not is_full_sphere(photo.width, photo.height)]
    if len(partial) > len(photos) / 2:
        which = f"{len(partial)} of {len(photos)} photographs of {source} are panoramas ({', '.join(partial[:3])})"
        fail(f"{which} that do not show all directions, twice as wide as high. Take single photographs instead.")
    left_out |= dict.fromkeys(partial, "a panorama, but not of all directions (twice as wide as high)")
    return [photo for photo in photos if photo.name not in left_out]


def ordered(photos: list[Photo]) -> list[Photo]:
    """Sort by time if all photographs have one and they differ."""
    times = {photo.exif.time for photo in photos}
    return sorted(photos, key=lambda photo: photo.exif.time) if "" not in times and len(times) > 1 else photos


def make_job(
    photos: Sequence[Photo],
    images: Path,
    used: Mapping[str, str],
    masks: Mapping[str, Path],
    options: SfmOptions,
    work: Path,
    sequence: bool,
) -> Job:
    """Make the job of photographs in this order, linked in the work folder under plain names. `images`: folder of the
    upright photographs, `used` their names in it; in a `sequence` neighbours overlap."""
    links, plain = emptied(work / "links"), {}
    for i, photo in enumerate(photos):
        plain[photo.name] = f"{i:06d}{Path(used[photo.name]).suffix.lower()}"
        (links / plain[photo.name]).symlink_to((images / used[photo.name]).resolve())
    masked = {plain[p.name]: (masks[p.name], (p.width, p.height)) for p in photos if p.name in masks}
    positions, _ = local_positions({p.name: p.exif.position for p in photos if p.exif.position is not None})
    cameras = [camera_group(members, [plain[p.name] for p in members], options) for members in by_camera(photos)]
    folders = str(work.resolve()), str(links.resolve()), write_colmap_masks(work / "masks", masked)
    return Job(
        *(*folders, cameras, list(plain.values())),
        names={plain[photo.name]: used[photo.name] for photo in photos},
        sequence=sequence,
        positions={plain[name]: position for name, position in positions.items()},
        opencv_if_better=options.camera_model == "auto",
        **{name: getattr(options, name) for name in ("matching", "mapper", "max_image_size", "max_features")},
    )


def by_camera(photos: Sequence[Photo]) -> list[list[Photo]]:
    """Group photographs by kind, size and EXIF camera and focal length."""
    groups: dict[tuple[object, ...], list[Photo]] = defaultdict(list)
    for photo in photos:
        groups[photo.panorama, photo.exif.camera, photo.width, photo.height].append(photo)
    return list(groups.values())


def camera_group(photos: Sequence[Photo], names: list[str], options: SfmOptions) -> CameraGroup:
    width, height = photos[0].width, photos[0].height
    if photos[0].panorama:
        return CameraGroup(ColmapCamera(SPHERICAL_MODEL, width, height, (float(width), float(height))), True, names)
    stated = [photo.exif.focal_length for photo in photos if photo.exif.focal_length]
    focal = options.focal_length or (statistics.median(stated) if len(stated) == len(photos) else None)
    model = "SIMPLE_RADIAL" if options.camera_model == "auto" else options.camera_model
    start = focal or GUESSED_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(0, model, start, width, height)
    return CameraGroup(ColmapCamera(model, width, height, tuple(camera.params.tolist())), focal is not None, names)


def _write(work: Path, images: Path, values: dict[str, object], photos: Sequence[Photo], job: Job) -> FoundPoses:
    """Move the model to its world frame, write it with its report, and remove temporary files."""
    model = pycolmap.Reconstruction(work / MODEL)
    by_used = {job.names[plain]: photo for plain, photo in zip(job.order, photos, strict=True)}
    gps = {name: photo.exif.position for name, photo in by_used.items() if photo.exif.position is not None}
    ups = {name: photo.exif.up for name, photo in by_used.items() if photo.exif.up is not None}
    frame = move_to_world(model, gps, ups)
    values |= {"up": frame.up, "metres_per_unit": frame.metres_per_unit, "gps_error": frame.gps_error}
    known = {job.names[plain] for group in job.cameras if group.prior for plain in group.names}
    stated = {image.camera_id for image in model.images.values() if image.name in known}  # a model's file has no priors
    values["cameras"] = [{"model": c.model_name, "width": c.width, "height": c.height, "params": c.params.tolist(),
                          "prior": c.camera_id in stated} for c in model.cameras.values()]  # fmt: skip
    kept = {each.name: values[each.name] for each in fields(FoundPoses) if each.name in values}
    with complete_folder(work / "result") as result:
        sparse = result / SPARSE
        sparse.mkdir(parents=True)
        write_model(model, sparse)
        write_frame(result, frame)
        write_report(result, values, model)
        write_file(result / "poses.json", json.dumps({"made": images == work / sfm_photos.IMAGES, **kept}).encode())
    process.delete_work(work, "links", "masks", MODEL)
    poses = _finished(work, images)
    assert poses is not None
    return poses
