"""A baked scene: surfels and an atlas, no network. Forward only, nothing here learns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from bitymi_ns.ops import baked_cpu, project, view_color
from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.ops.baked import AtlasTexture, BakedArrays, WorkspacePool, draw, empty_images
from bitymi_ns.ops.constants import TRANSMITTANCE_MIN

from .camera import Camera


@dataclass
class BakedOutput:
    """A view of a baked scene; the fields mean what they mean in `scene.RenderOutput`."""

    rgb: Tensor
    alpha: Tensor
    beta: Tensor | None
    depth: Tensor | None
    normal: Tensor | None
    overdraw: Tensor | None


@dataclass
class BakedScene:
    """A baked scene and its renderer, on the CPU or, after `to`, on a CUDA device: what the bake makes, and what a
    bundle holds.

    Attributes:
        surfels: per-surfel parameters by name (docs/overview.md), float32.
        view_color: a name of `ops.VIEW_COLORS`.
        tiles: [N, 5] int32: x, y, layer, r_u, r_v in texels; r_u = 0: no tile.
        atlas: [layers, height, width, 4] uint8 or float32 on the CPU, None = no residual. On a CUDA device float texels
            become float16.
        blocks: [layers, height / 4, width / 4, 16] uint8 on the CPU, the same atlas as BC7 blocks, which a CUDA device
            reads as they are; None = not given. The CPU needs `atlas`.
        offset, scale: residual = offset + scale * value, value = stored / 255 for uint8, stored for float32.
        extent: [N] half side of the tile in scale units, None = 3, the kernel's support, everywhere.
        mean_residual: [N, 3] float32 mean residual of every tile; a surfel without a tile has this residual. None = 0.
        near: nearest depth that is drawn, camera z.
        weight_bound: fragments of smaller blending weight keep the surfel's colour without the residual.
        prefilter: low_pass or pixel, as in `SceneConfig`.
        transmittance_min: a surfel that would leave a pixel less transmittance is not blended and ends the pixel, as in
            training; 0 = every surfel is blended.
    """

    surfels: Mapping[str, Tensor]
    view_color: str
    tiles: Tensor
    atlas: Tensor | None = None
    offset: float = 0.0
    scale: float = 1.0
    extent: Tensor | None = None
    mean_residual: Tensor | None = None
    near: float = 0.2
    weight_bound: float = 0.0
    prefilter: str = "low_pass"
    transmittance_min: float = TRANSMITTANCE_MIN
    blocks: Tensor | None = None
    _patches: tuple | None = field(default=None, init=False, repr=False, compare=False)
    _texture: tuple[Tensor, torch.device, AtlasTexture] | None = field(
        default=None, init=False, repr=False, compare=False
    )
    _workspaces: WorkspacePool = field(default_factory=WorkspacePool, init=False, repr=False, compare=False)

    def residuals(self) -> Tensor:
        """Residual colours of the atlas: [layers, height, width, 3] float32.

        Raises:
            ValueError: there is no atlas, or only its BC7 blocks.
        """
        if self.atlas is None:
            raise ValueError("the scene has no atlas" if self.blocks is None else "the atlas was not decoded")
        rgb = self.atlas[..., :3].float()
        unorm = rgb / 255.0 if self.atlas.dtype == torch.uint8 else rgb
        return unorm * self.scale + self.offset

    def to(self, device: torch.device | str) -> BakedScene:
        """The scene with its surfels on another device; texels go there, as textures, when it is first drawn."""

        def moved(t: Tensor | None) -> Tensor | None:
            return None if t is None else t.to(device)

        surfels = {name: value.to(device) for name, value in self.surfels.items()}
        optional = {"extent": moved(self.extent), "mean_residual": moved(self.mean_residual)}
        return replace(self, surfels=surfels, tiles=self.tiles.to(device), **optional)

    def arrays(self) -> BakedArrays:
        """The scene as the CUDA kernels take it (`ops.baked`), its atlas as textures on the device of the surfels.

        Raises:
            TypeError: the surfels are not float32.
        """
        device = self.tiles.device
        texels = self.blocks if self.blocks is not None and device.type == "cuda" else self.atlas
        if texels is not None and (
            self._texture is None or self._texture[0] is not texels or self._texture[1] != device
        ):
            self._texture = (texels, device, AtlasTexture(texels, texels is self.blocks, device))
        return BakedArrays(
            self.surfels,
            self.view_color,
            self.tiles,
            None if texels is None or self._texture is None else self._texture[2],
            self.offset,
            self.scale,
            self.extent,
            self.mean_residual,
            self.near,
            self.weight_bound,
            self.through_pixel,
            self.transmittance_min,
        )

    @property
    def through_pixel(self) -> bool:
        """Whether the kernel is seen through a pixel."""
        return self.prefilter == "pixel"

    def __len__(self) -> int:
        return len(self.tiles)

    @torch.no_grad()
    def render(self, camera: Camera, background: Tensor | None = None, maps: bool = False) -> BakedOutput:
        """Renders a view: texels are fetched bilinearly, clamped to the tile's outer texel centres.

        On a CUDA device this waits for the image, to see whether its working memory was large enough;
        `baked_renderer.BakedRenderer` does not.

        Args:
            camera: the view.
            background: [3] colour behind the scene; None = black.
            maps: also beta, depth, normals and overdraw.

        Raises:
            ValueError: the scene is on the CPU, and its atlas only as BC7 blocks.
        """
        if cuda_backend(self.tiles.device):
            names = ("rgb", "alpha", *(("beta", "depth", "normal", "overdraw") if maps else ()))
            images = {name: image[0] for name, image in self.render_views([camera], background, names).items()}
            return BakedOutput(*(images.get(name) for name in ("rgb", "alpha", "beta", "depth", "normal", "overdraw")))
        if self.atlas is None and self.blocks is not None:
            raise ValueError("the CPU needs decoded texels: read the bundle with decode=True")
        p = self.surfels
        means = p["means"]
        geometry = (means, p["quats"], p["log_scales"], p["opacity_logits"], p["beta_raw"])
        projection = project(*geometry, camera, self.near, self.through_pixel)
        base = view_color(self.view_color, p, means, camera.exact_center, projection.visible)
        is_bytes = self.atlas is not None and self.atlas.dtype == torch.uint8
        image, overdraw = baked_cpu.draw(
            projection,
            base,
            self._gathered(),
            self.offset,
            self.scale / 255 if is_bytes else self.scale,
            self.extent,
            self.mean_residual,
            self.weight_bound,
            self.transmittance_min,
            maps,
        )
        rgb, alpha = image[..., :3], image[..., 3:4]
        if background is not None:
            rgb = rgb + (1 - alpha) * background
        beta, depth, normal = (image[..., 4:5], image[..., 5:6], image[..., 6:9]) if maps else (None, None, None)
        return BakedOutput(rgb, alpha, beta, depth, normal, overdraw)

    def _gathered(self):
        """The atlas as the kernel reads it: gathered for the first view, kept while atlas and tiles are the same."""
        atlas, tiles = self.atlas, self.tiles
        state = (id(atlas), 0 if atlas is None else atlas._version, id(tiles), tiles._version)
        if self._patches is None or self._patches[0] != state:
            self._patches = (state, baked_cpu.gather(atlas, tiles))
        return self._patches[1]

    @torch.no_grad()
    def render_views(
        self, cameras: Sequence[Camera], background: Tensor | None = None, images: Sequence[str] = ("rgb", "alpha")
    ) -> dict[str, Tensor]:
        """Renders views of one size on a CUDA device, all in one go.

        Args:
            cameras: at least one.
            background: [3] colour behind the scene; None = black.
            images: what to draw, names of `ops.baked.IMAGES`.

        Returns:
            name -> [views, height, width, channels].

        Raises:
            ValueError: the cameras differ in size or have skew, or views times surfels is above 2^24.
            RuntimeError: the scene is on the CPU; or the device has too little memory.
        """
        device = self.tiles.device
        if not cuda_backend(device):
            raise RuntimeError(
                "views are drawn together on a CUDA device only: move the scene there, or render one by one"
            )
        viewmats, Ks, width, height = stack_cameras(cameras, device)
        arrays = self.arrays()
        background = None if background is None else background.to(device, torch.float32).contiguous()
        to = empty_images(tuple(images), len(cameras), width, height, device)
        workspace = self._workspaces.take()
        workspace.fit(arrays, len(cameras), width, height, "normal" in to)
        draw(arrays, viewmats, Ks, background, to, workspace)
        if len(self) and not workspace.settle():
            workspace.fit(arrays, len(cameras), width, height, "normal" in to)
            draw(arrays, viewmats, Ks, background, to, workspace)
            workspace.settle()  # waits: the next frame may use the memory on another stream
        self._workspaces.give(workspace)
        return to


def stack_cameras(cameras: Sequence[Camera], device: torch.device) -> tuple[Tensor, Tensor, int, int]:
    """Cameras of one size as viewmats [V, 4, 4] and Ks [V, 3, 3], float32 on `device`, with width and height.

    Raises:
        ValueError: there is none, they differ in size, or one has skew.
    """
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"views that are drawn together need one size, not {sorted(sizes)}")
    if any(camera.skewed for camera in cameras):
        raise ValueError("cameras with skew (K[0, 1] != 0) are not supported: undistort the images first")
    viewmats = torch.stack([camera.viewmat for camera in cameras]).to(device, torch.float32)
    Ks = torch.stack([camera.K for camera in cameras]).to(device, torch.float32)
    return viewmats, Ks, *sizes.pop()
