"""Convert nerfstudio's cameras, and check them; convert depth and normals for its tools."""

import math
from collections.abc import Sequence

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from ..console import fail, listed, warn

MAX_OFF_AXIS = 80  # largest angle from the optical axis to the picture's middle, degrees
USUAL_VIEW = (0.5, 150.0)  # of plausible focal lengths, degrees
POSSIBLE_VIEW = (0.01, 178.0)  # of accepted focal lengths, degrees


def to_camera(cameras: Cameras, device: torch.device | str | None = None) -> Camera:
    """Convert one of nerfstudio's cameras (OpenGL axes: x right, y up, z backward) to OpenCV axes. Raises InputError:
    it is not a perspective camera, or has distortion."""
    cameras = cameras.reshape((-1,))
    if cameras.shape[0] != 1:
        raise ValueError(f"expected one camera, found {cameras.shape[0]}")
    names = ("camera_type", "fx", "fy", "cx", "cy", "width", "height", "camera_to_worlds", "distortion_params")
    fields = (getattr(cameras, name) for name in names)
    # one copy from the device: each waits
    row = torch.cat([field[0].detach().flatten().double() for field in fields if field is not None]).cpu()
    kind, fx, fy, cx, cy, width, height = row[:7].tolist()
    if int(kind) != CameraType.PERSPECTIVE.value:
        fail(f"cameras of type {CameraType(int(kind)).name.lower()} cannot be rendered; only perspective cameras can")
    if bool((row[19:] != 0).any()):
        fail("a camera has lens distortion: undistort the capture first (COLMAP's image_undistorter).")
    c2w = row[7:19].view(3, 4)
    rotation = c2w[:, :3] * c2w.new_tensor([1.0, -1.0, -1.0])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ c2w[:, 3]
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, int(width), int(height)).to(cameras.device if device is None else device)


def to_cameras(cameras: Cameras, device: torch.device | str | None = None) -> list[Camera]:
    return [to_camera(cameras[i : i + 1], device) for i in range(len(cameras))]


def check_cameras(cameras: Sequence[Cameras], names: Sequence[object]) -> None:
    """Fail or warn if a pinhole camera sees nothing, or its focal length does not fit its size."""

    def column(name: str) -> Tensor:
        return torch.cat([getattr(split, name).flatten() for split in cameras]).double()

    fx, fy, cx, cy, width, height = (column(name) for name in ("fx", "fy", "cx", "cy", "width", "height"))
    poses = torch.cat([split.camera_to_worlds.flatten(1) for split in cameras])
    off_axis = torch.hypot((cx - 0.5 * width) / fx, (cy - 0.5 * height) / fy)
    far = f"so far from the picture that this lies more than {MAX_OFF_AXIS} degrees off its axis"
    for what, wrong in (
        ("its pose is not finite", ~poses.isfinite().all(1)),
        (f"its principal point is {far}", off_axis > math.tan(math.radians(MAX_OFF_AXIS))),
    ):
        if bool(wrong.any()):
            fail(f"the camera of {names[int(wrong.nonzero()[0])]} cannot be used: {what}. Correct the capture.")
    for key, size, focal in (("fl_x", width, fx), ("fl_y", height, fy)):
        degrees = 2.0 * torch.rad2deg(torch.atan(0.5 * size / focal))
        for (least, most), refused in ((POSSIBLE_VIEW, True), (USUAL_VIEW, False)):
            unusual = (~((degrees >= least) & (degrees <= most))).nonzero().flatten().tolist()
            if not unusual:
                continue
            i = unusual[0]
            what = f"focal length of {listed([names[j] for j in unusual])} is {focal[i]:g} pixels ({key})"
            span = f"{int(size[i])} pixels of the picture span {degrees[i]:.3g} degrees"
            unit = "It is in pixels, not in millimetres, and camera_angle_x is in radians"
            if refused:
                fail(f"the {what}: {span}. {unit}. Correct the capture.")
            warn(f"The {what}: {span}. {unit}. If that is a mistake, correct the capture.")
            return


def ray_distance(depth: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Convert blended depth [H, W, 1], the sum of w z, and alpha [H, W, 1], the sum of w, to nerfstudio's depth [H, W,
    1], the expected distance along the ray; empty pixels get the largest one."""
    height, width = depth.shape[:2]
    x = (torch.arange(width, device=depth.device) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (torch.arange(height, device=depth.device) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    distance = depth / alpha.clamp(min=1e-6) * torch.sqrt(1.0 + x[None, :, None] ** 2 + y[:, None, None] ** 2)
    seen = alpha > 1e-3
    return torch.where(seen, distance, torch.where(seen, distance, 0.0).max())


def normal_image(normal: Tensor, camera: Camera) -> Tensor:
    """Convert blended camera-frame normals [H, W, 3] to colors (n + 1) / 2 of world normals; 0 in empty pixels."""
    length = normal.norm(dim=-1, keepdim=True)
    unit = normal / length.clamp(min=1e-6)
    # R^T n without a matrix product, which cuBLAS refuses to deterministic algorithms
    world = (unit[..., None] * camera.viewmat[:3, :3]).sum(-2)
    return torch.where(length > 1e-3, 0.5 * (world + 1.0), 0.0)
