"""Types of the package: `CaptureError`, photographs and cameras, options."""

import logging
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from bitymi_ns.safe_reading import reading

if TYPE_CHECKING:
    import pycolmap

Pose = npt.NDArray[np.float64]
OPENCV_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # [4, 4] between camera frames with OpenCV axes and with OpenGL's
SPHERICAL_MODEL = "EQUIRECTANGULAR"  # COLMAP's model of 360-degree pictures, with parameters width and height
ASPECT = 0.01  # relative tolerance of the aspect ratio 2 of 360-degree pictures
Orientation = Literal["pca", "up", "vertical", "none"]

CONTRADICTED = 0.1
"""Share of contradicted matches that makes poses doubtful: right ones have 0.012 to 0.016, wrong ones 0.20 and 0.27."""


class CaptureError(ValueError):
    """Error in a capture, photographs or a video; names the problem, the file and the remedy."""


_log = logging.getLogger("bitymi_ns.capture")
say, warn = _log.info, _log.warning  # one line each


def fail(message: str, cause: BaseException | None = None) -> NoReturn:
    raise CaptureError(message) from cause


def parsing(
    what: object, advice: str = "", passing: tuple[type[BaseException], ...] = ()
) -> AbstractContextManager[None]:
    """Convert any exception in the block to a CaptureError; see `reading`."""
    return reading(what, CaptureError, advice, (CaptureError, *passing))


MAP_FILES = (".png", ".tif", ".tiff", ".npy", ".npz", ".exr")  # extensions of depth and normal maps


@dataclass(frozen=True)
class MapFiles:
    """Files of depth and normals beside a photograph."""

    depth: Path | None = None  # camera z, see `read_depth`
    confidence: Path | None = None  # of the depth, 0 = low; no larger than the depth map
    normal: Path | None = None  # see `read_normal`


def is_full_sphere(width: float, height: float) -> bool:
    """Test for the aspect ratio of a 360-degree picture, up to rounding."""
    return abs(width / (2.0 * height) - 1.0) <= ASPECT + 1.0 / height


def scaled_size(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """Scale a width and a height in pixels, to at least 1."""
    width, height = (max(1, round(side * factor)) for side in size)
    return width, height


class ColmapCamera(NamedTuple):
    """Camera model of COLMAP, picture size in pixels, and parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height

    @property
    def colmap(self) -> "pycolmap.Camera":
        from . import pycolmap  # slow

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    def pixels_of(self, points: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Project points [n, 3] in the camera's frame to pixels [n, 2]."""
        pixels = self.colmap.img_from_cam(points)
        assert pixels is not None  # as for a single point that has none
        return pixels

    def within(self, side: int) -> tuple[int, int]:
        """Return the size of pictures reduced to at most `side` pixels along the longer side."""
        return scaled_size(self.size, min(1.0, side / max(self.size)))

    def rescaled(self, width: int, height: int) -> "ColmapCamera":
        """Return the camera for the same pictures in another size."""
        if (width, height) == self.size:
            return self
        if self.model == SPHERICAL_MODEL:
            return self._replace(width=width, height=height, params=(float(width), float(height)))
        camera = self.colmap
        camera.rescale(width, height)
        return self._replace(width=width, height=height, params=tuple(camera.params))


@dataclass(frozen=True)
class Photograph:
    file: Path
    camera: ColmapCamera  # in pixels before downscaling
    pose: Pose  # [4, 4] camera to world, OpenGL axes (camera: x right, y up, z backward)
    label: str  # names the camera in messages
    mask: Path | None = None
    downscaled: bool = False  # `file` is a downscaled copy
    frame: int | None = None  # shared by photographs that a rig took together; None = it stands alone
    maps: MapFiles = MapFiles()


@dataclass
class FrameOptions:
    """Orientation, centering and scaling of a capture, as in nerfstudio's parsers."""

    scale_factor: float = 1.0  # Factor on the positions of the cameras.
    orientation_method: Orientation = "up"  # Orientation of the capture: up = the cameras' mean up is z.
    center_method: Literal["poses", "focus", "none"] = "poses"
    """Origin: the middle of the cameras, or the point that they face."""
    auto_scale_poses: bool = True  # Scale the capture so that the cameras fit into a box from -1 to 1.
    scene_scale: float = 1.0  # Half the side of the box of random points.


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion; they are part of the key under which a result is cached."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Pairs to match: all (exhaustive), neighbors and similar ones (sequential), or by number, order and GPS (auto)."""
    mapper: Literal["auto", "global", "incremental"] = "auto"
    """Register all cameras at once (global) or one after the other (incremental); auto = global, else incremental."""
    camera_model: Literal[
        "auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "EQUIRECTANGULAR"
    ] = "auto"
    """Camera model of COLMAP; auto = SIMPLE_RADIAL, OPENCV if that lowers the reprojection error, and EQUIRECTANGULAR
    for detected 360-degree pictures."""
    focal_length: float | None = None  # Focal length of all photographs in pixels; None = from EXIF or estimated.
    max_image_size: int = 1600  # Detect features on photographs downscaled to this many pixels along the longer side.
    max_features: int = 8192  # Most features per photograph.
    frames: int | None = None  # Number of frames of a video; None = by camera motion.


@dataclass(frozen=True)
class SfmOptions(SfmSettings):
    """Settings, and the folder of masks. Raises CaptureError: one is out of its range."""

    masks: Path | None = None
    """Folder of masks; black pixels get no features. None = `masks` beside the photographs or in their folder, if
    any."""
    use_masks: bool = True  # Use masks; else ignore their folder.

    def __post_init__(self) -> None:
        least = {"max_image_size": 200, "max_features": 100, "frames": 3, "focal_length": 1}
        for name, limit in least.items():
            value = getattr(self, name)
            if value is not None and not limit <= value <= 1e6:
                raise CaptureError(f"{name} is {value}: give a number from {limit} to 1,000,000")


@dataclass(frozen=True)
class FoundPoses:
    model: Path
    """Folder of a COLMAP model in full-size pixels of `images`, distorted as they are; frame.json in `report` states
    its up and metres."""
    images: Path  # Folder that image names are relative to: of the photographs, of upright copies or of frames.
    report: Path  # Folder with report.json, cameras.png and frame.json.
    left_out: dict[str, str]  # Photographs that have no pose, by name, and why.
    registered: int  # Number of photographs that have a pose.
    given: int  # Number of photographs, or of frames taken of a video.
    reprojection_error: float  # Mean over all observations, in pixels of the photographs.
    track_length: float  # Mean number of photographs that see a point.
    seconds: dict[str, float]  # Wall time per stage.
    contradicted: float = 0.0  # Share of the verified matches that the poses contradict.

    @property
    def doubt(self) -> str:
        """Reason to doubt the poses, and what to do; empty = none."""
        if self.contradicted <= CONTRADICTED:
            return ""
        why = "parts of the scene look alike or moved, and photographs may be misplaced"
        advice = f"Look at {self.report / 'cameras.png'}; take more photographs that show what differs, or panoramas."
        return f"{self.contradicted:.0%} of what photographs have in common contradicts their poses: {why}. {advice}"
