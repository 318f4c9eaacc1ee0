"""nerfstudio cameras as ours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from bitymi_ns.capture.panorama import PANORAMAS
from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.scene.camera import Camera

UNDISTORTED = (CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.FISHEYE624)
"""Kinds of cameras whose photographs become those of a perspective camera on loading."""
OFF_AXIS = 80
"""Degrees between the axis and the middle of the picture that no perspective camera has."""
USUAL_VIEW = (0.5, 150.0)
"""Degrees that a picture of a perspective camera may span; outside, the focal length is doubtful."""
POSSIBLE_VIEW = (0.01, 178.0)
"""Degrees that a picture may span at all: outside of these nothing but the middle pixels, or a single ray, would be
seen, which cannot be meant."""
LITTLE_LEFT = 0.25
"""Share of a photograph's area; where undistorting leaves less, the numbers are doubtful."""
NOTHING_LEFT = 0.05
"""Share of a photograph's area; where undistorting leaves less, the numbers cannot be meant."""


def to_camera(cameras: Cameras, device: torch.device | str | None = None) -> Camera:
    """One nerfstudio camera (OpenGL axes: x right, y up, z backward) in OpenCV axes, as a world-to-camera matrix.

    Args:
        cameras: a single camera, of shape () or (1,).
        device: where the result is to be; default: where the camera is.
    """
    cameras = cameras.reshape((-1,))
    if cameras.shape[0] != 1:
        raise ValueError(f"expected one camera, found {cameras.shape[0]}")
    if int(cameras.camera_type[0]) != CameraType.PERSPECTIVE.value:
        kind = CameraType(int(cameras.camera_type[0])).name.lower()
        fail(f"cameras of type {kind} cannot be rendered; only perspective cameras can")
    distortion = cameras.distortion_params
    if distortion is not None and bool((distortion != 0).any()):
        fail(
            "a camera has lens distortion, which this method does not render. Training and evaluation undistort the "
            "images on loading; for other tools have the capture read with `bitymi-data`, the default, or undistort it "
            "first (COLMAP's image_undistorter)."
        )
    c2w = cameras.camera_to_worlds[0].detach().double()  # [3, 4]
    rotation = c2w[:, :3] * c2w.new_tensor([1.0, -1.0, -1.0])
    viewmat = torch.eye(4, dtype=torch.float64, device=c2w.device)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ c2w[:, 3]
    K = torch.eye(3, dtype=torch.float64, device=c2w.device)
    K[0, 0], K[1, 1] = cameras.fx[0].item(), cameras.fy[0].item()
    K[0, 2], K[1, 2] = cameras.cx[0].item(), cameras.cy[0].item()
    camera = Camera(viewmat.float(), K.float(), int(cameras.width[0]), int(cameras.height[0]))
    return camera if device is None else camera.to(device)


def check_cameras(cameras: Cameras, names: Sequence[object]) -> None:
    """Stop, or warn, at cameras through which nothing can be seen, or next to nothing.

    Args:
        cameras: [N] of a capture, with the lens distortion of the photographs as they are stored.
        names: of the N photographs, for messages.
    """
    distortion = cameras.distortion_params
    kind = cameras.camera_type
    kinds = torch.tensor([known.value for known in UNDISTORTED], device=kind.device)
    distorted = torch.zeros(len(kind), dtype=torch.bool) if distortion is None else (distortion != 0).any(-1)
    for what, wrong in (
        ("its pose is not finite", ~cameras.camera_to_worlds.isfinite().flatten(1).all(1)),
        (
            "its focal lengths are not positive and finite",
            ~((cameras.fx > 0) & (cameras.fy > 0) & (cameras.fx + cameras.fy < 1e12)),
        ),
        ("its principal point is not finite", ~(cameras.cx + cameras.cy).isfinite()),
        ("its image size is not positive", (cameras.width < 1) | (cameras.height < 1)),
        (
            f"its principal point is so far from the picture that this lies more than {OFF_AXIS} degrees off its axis",
            torch.hypot(
                (cameras.cx - 0.5 * cameras.width) / cameras.fx, (cameras.cy - 0.5 * cameras.height) / cameras.fy
            )
            > math.tan(math.radians(OFF_AXIS)),
        ),
        (
            "it is neither a perspective nor a fisheye camera, which are the kinds that can be trained on, but "
            f"{_kind_names(kind[~torch.isin(kind, kinds)])}",
            ~torch.isin(kind, kinds),
        ),
        (
            "it is a fisheye camera without coefficients (k1 to k4), by which its photographs could be undistorted",
            (kind != CameraType.PERSPECTIVE.value).flatten() & ~distorted,
        ),
        (
            "its lens distortion is not finite",
            distorted & False if distortion is None else ~distortion.isfinite().all(-1),
        ),
    ):
        if bool(wrong.any()):
            remedy = PANORAMAS if CameraType.EQUIRECTANGULAR.name in what else "Correct the capture."
            fail(f"the camera of {names[int(wrong.flatten().nonzero()[0])]} cannot be used: {what}. {remedy}")
    if distortion is not None:
        _check_distortion(cameras, names)


def _kind_names(kinds: Tensor) -> str:
    return ", ".join(CameraType(value).name for value in kinds.unique().tolist())


def check_views(cameras: Sequence[Cameras], names: Sequence[object]) -> None:
    """Stop, or warn, at focal lengths that do not go with the size of the pictures.

    Args:
        cameras: of training and of held-out views, with positive focal lengths.
        names: of the photographs of all of them, for messages.
    """
    perspective = torch.cat([some.camera_type.flatten() for some in cameras]) == CameraType.PERSPECTIVE.value
    for key, sizes, focals in (
        ("fl_x", [some.width for some in cameras], [some.fx for some in cameras]),
        ("fl_y", [some.height for some in cameras], [some.fy for some in cameras]),
    ):
        size, focal = (torch.cat([some.flatten() for some in values]).double() for values in (sizes, focals))
        degrees = 2.0 * torch.rad2deg(torch.atan(0.5 * size / focal))
        for (least, most), refused in ((POSSIBLE_VIEW, True), (USUAL_VIEW, False)):
            wrong = (perspective & ~((degrees >= least) & (degrees <= most))).nonzero().flatten().tolist()
            if not wrong:
                continue
            i = wrong[0]
            message = (
                f"focal length of {listed([names[j] for j in wrong])} is {focal[i]:g} pixels ({key}): "
                f"{int(size[i])} pixels of the picture span {degrees[i]:.3g} degrees. Focal lengths are in "
                "pixels, not in millimetres, and camera_angle_x is in radians."
            )
            if refused:
                fail(f"the {message} Correct the capture.")
            warn(f"The {message} If that is a mistake, correct the capture.")
            return


def _check_distortion(cameras: Cameras, names: Sequence[object]) -> None:
    """Photographs of perspective cameras are cropped to what is left of them when they have been undistorted."""
    perspective = (cameras.camera_type == CameraType.PERSPECTIVE.value).flatten()
    if bool(perspective.any()) and cameras.distortion_params.shape[-1] != 6:
        fail(
            f"the cameras have {cameras.distortion_params.shape[-1]} distortion_params; perspective cameras need six: "
            "k1, k2, k3, k4, p1, p2. Correct the capture."
        )
    columns = (cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height)
    rows = torch.cat([*(c.double() for c in columns), cameras.distortion_params.double()], -1)
    rows[~perspective] = 0.0
    doubtful = []
    for row in rows.unique(dim=0):
        if not bool(row[6:].any()):
            continue
        *pinhole, k1, k2, k3, k4, p1, p2 = row.tolist()
        whose = listed([names[int(i)] for i in (rows == row).all(-1).nonzero()])
        if k4 != 0.0:
            fail(
                f"the camera of {whose} cannot be used: its k4 is {k4:g}, but perspective cameras are undistorted by "
                "k1, k2, k3, p1 and p2 alone. Undistort the photographs first (COLMAP's image_undistorter)."
            )
        share = _share_left(pinhole, (k1, k2, k3, p1, p2))
        if share < NOTHING_LEFT:
            fail(
                f"the lens distortion of {whose} is absurd: with {_named(k1, k2, k3, p1, p2)} undistorting would leave "
                f"{100.0 * share:.2g} % of the picture. Correct the numbers, or calibrate again with a simpler camera "
                "(one coefficient)."
            )
        if share < LITTLE_LEFT:
            doubtful.append(f"{100.0 * share:.2g} % of {whose} ({_named(k1, k2, k3, p1, p2)})")
    if doubtful:
        warn(f"Undistorting leaves only {'; '.join(doubtful)}. The lens distortion may be wrong.")


def _share_left(pinhole: Sequence[float], coefficients: Sequence[float]) -> float:
    """Share of a photograph's area that is left when it has been undistorted; 0 where the distortion folds it.

    Args:
        pinhole: fx, fy, cx, cy, width, height in pixels.
        coefficients: k1, k2, k3, p1, p2.
    """
    fx, fy, cx, cy, width, height = pinhole
    k1, k2, k3, p1, p2 = coefficients
    # a point r from the axis is seen at r (1 + k1 r^2 + k2 r^4 + k3 r^6); beyond the first r where that no longer grows
    # there is nothing to see
    turns = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # squares of such r
    first = min((t.real for t in turns if abs(t.imag) < 1e-9 and t.real > 0.0), default=math.inf)
    nearest_edge = min(abs(edge) for edge in (cx / fx, (width - cx) / fx, cy / fy, (height - cy) / fy))
    if first < math.inf and math.sqrt(first) * (1.0 + first * (k1 + first * (k2 + first * k3))) < nearest_edge:
        return 0.0
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    order = np.array([k1, k2, p1, p2, k3])
    new, (_, _, w, h) = cv2.getOptimalNewCameraMatrix(K, order, (int(width), int(height)), 0)
    return w / width * min(1.0, fx / new[0, 0]) * h / height * min(1.0, fy / new[1, 1])


def _named(*values: float) -> str:
    return ", ".join(
        f"{name} = {value:g}" for name, value in zip(("k1", "k2", "k3", "p1", "p2"), values, strict=True) if value
    )


def ray_distance(depth: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Expected distance along each pixel's ray, which is what nerfstudio's tools take for depth.

    Args:
        depth: [H, W, 1] sum of w z, camera z.
        alpha: [H, W, 1] sum of w.

    Returns:
        [H, W, 1]; where nothing is seen the largest distance in the picture.
    """
    height, width = depth.shape[:2]
    x = (torch.arange(width, device=depth.device) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (torch.arange(height, device=depth.device) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    distance = depth / alpha.clamp(min=1e-6) * torch.sqrt(1.0 + x[None, :, None] ** 2 + y[:, None, None] ** 2)
    seen = alpha > 1e-3
    return torch.where(seen, distance, torch.where(seen, distance, 0.0).max())


def normal_image(normal: Tensor, camera: Camera) -> Tensor:
    """Blended normals of the camera frame, [H, W, 3], as colours of the unit world normal, (n + 1) / 2; 0 for none."""
    length = normal.norm(dim=-1, keepdim=True)
    unit = normal / length.clamp(min=1e-6)
    # R^T n; no product of matrices, which cuBLAS would refuse where torch is asked for deterministic algorithms
    world = (unit[..., None] * camera.viewmat[:3, :3]).sum(-2)
    return torch.where(length > 1e-3, 0.5 * (world + 1.0), 0.0)
