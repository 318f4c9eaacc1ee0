"""Files of cameras and other programs that are not read as photographs or poses, to be reported."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from bitymi_ns.reading import read_bytes

RAW = "raw data of a camera"
PICTURES = {
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"), RAW),
    ".jxl": "JPEG XL",
    ".exr": "OpenEXR",
    ".hdr": "Radiance HDR",
    ".psd": "Photoshop",
}
"""Extensions of unread images, and their formats."""
POSES = {
    "poses_bounds.npy": "LLFF",
    "cameras_sphere.npz": "NeuS",
    "cameras.npz": "IDR",
    "cameras.sfm": "Meshroom",
    "sfm_data.json": "OpenMVG",
    "reconstruction.json": "OpenSfM",
    "bundle.out": "Bundler",
    "bundle.rd.out": "Bundler",
}
"""Files of poses, in lower case, and the programs that write them."""
METASHAPE = b"<camera "  # content of the XML file to which Metashape exports cameras, whatever its name
FOLDERS = {
    "mask": "masks", "masks": "masks", "depth": "depth maps", "depths": "depth maps", "depth_maps": "depth maps",
    "confidence": "confidence maps", "confidences": "confidence maps", "conf": "confidence maps",
    "normal": "normal maps", "normals": "normal maps", "normal_maps": "normal maps", "thumbnail": "thumbnails",
    "thumbnails": "thumbnails", "thumbs": "thumbnails", "sparse": "a model", "colmap": "a model", "dense": "a model",
    "stereo": "a model", "outputs": "outputs of training", "renders": "renders", "@eadir": "thumbnails",
    "segmentation": "segmentations", "segmentations": "segmentations", "semantic": "segmentations",
    "exports": "exports", "wandb": "pictures of a log", "planar_projections": "pictures made of panoramas",
}  # fmt: skip
"""Folders of a capture that hold no photographs, by their names in lower case, and what they hold."""
FILES = {
    r"thumb(nail)?(_\d+)?": "a thumbnail", r"material_0|textured_output": "a texture", r"dynamic_mask_.*":
    "a mask of instant-ngp", r"depth_\d+|.*[._-]depth": "a depth map", r"conf_\d+": "a confidence map",
}  # fmt: skip
"""Names files among photographs that are none: patterns of their names in lower case, without their endings."""


def poses_in(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield files of poses in a folder, each with the program that wrote it."""
    for path in sorted(path for path in folder.iterdir() if path.is_file()):
        if path.name.lower() in POSES:
            yield path, POSES[path.name.lower()]
        elif path.suffix.lower() == ".xml" and _is_metashapes(path):
            yield path, "Metashape"


def _is_metashapes(path: Path) -> bool:
    try:
        return METASHAPE in read_bytes(path)
    except OSError:  # it may not be read, and need not be
        return False


def pictures_among(names: Sequence[str], read: Sequence[str]) -> dict[str, int]:
    """Count unread images of a folder by extension. Raw data beside a photograph of the same name in `read` do not
    count."""
    stems = {Path(name).stem.lower() for name in read}
    endings = [path.suffix.lower() for path in map(Path, names) if path.stem.lower() not in stems]
    return {ending: endings.count(ending) for ending in PICTURES if ending in endings}
