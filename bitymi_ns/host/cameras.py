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


def distance_along_ray(depth: Tensor, camera: Camera) -> Tensor:
    """Depth along the viewing axis as distance along each pixel's ray, which is what nerfstudio's tools expect.

    Args:
        depth: [H, W, 1] camera z.

    Returns:
        [H, W, 1].
    """
    height, width = depth.shape[:2]
    x = (torch.arange(width, device=depth.device) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (torch.arange(height, device=depth.device) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    return depth * torch.sqrt(1.0 + x[None, :, None] ** 2 + y[:, None, None] ** 2)
