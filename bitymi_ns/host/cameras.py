"""nerfstudio cameras as ours."""

from __future__ import annotations

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from bitymi_ns.host.errors import fail
from bitymi_ns.scene.camera import Camera


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
            "images on loading; for other tools undistort the capture first (COLMAP's image_undistorter)."
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
