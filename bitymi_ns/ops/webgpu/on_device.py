"""Rendering of baked scenes through WebGPU, equal to the kernels': buffers, textures and passes."""

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..baked_cuda import decoded
from ..baked_scene import BakedSceneLike
from ..project import CameraLike
from .arrays import FRAME, SEEN, arrays
from .device import check_room, device, in_software, library
from .programs import Programs

SHOW = {"color": 0, "depth": 1, "normal": 2, "overdraw": 3}  # blended quantity, by its number in scene.wgsl
BLOCK, DIGITS, ROUNDS = 1024, 16, 8  # of sort.wgsl: keys per block, digits, rounds of 4 bits
MOST_LAYERS = 64
LAYERS = 16  # batches of surfels; docs/viewer.md has the image error of fewer
_FROM = {
    "rgb": ("color", slice(0, 3)),
    "alpha": ("color", slice(3, 4)),
    "depth": ("depth", slice(0, 1)),
    "beta": ("depth", slice(1, 2)),
    "normal": ("normal", slice(0, 3)),
    "overdraw": ("overdraw", slice(0, 1)),
}
_STRIDE = 256  # offset alignment of the uniforms of batches and rounds


@functools.cache
def programs() -> Programs:
    """The programs, for the most precise target that the device can blend."""
    format = "rgba32float" if "float32-blendable" in device().features else "rgba16float"
    return Programs(format)


@dataclass
class _Target:
    """Render targets for images of one size."""

    size: tuple[int, int]  # width, height
    sums: Any  # textures: the blended sums, and their copy from before a batch
    before: Any  # bind group of that copy
    read: Any  # buffer to read the sums back
    row_bytes: int  # bytes per row of `read`


class SceneOnDevice:
    """A scene, copied to textures and buffers of the WebGPU device. Raises WebGpuUnavailable: no device, or the scene
    exceeds its limits. Raises TypeError, ValueError: as `arrays`."""

    def __init__(self, scene: BakedSceneLike) -> None:
        self._programs, self._device = programs(), device()
        packed = arrays(scene)
        self._origin, self._kind = packed.origin, packed.kind
        self.count = len(packed.surfels)
        check_room(array_bytes=max(packed.surfels.nbytes, packed.terms.nbytes), groups=-(-self.count // 64))
        self._near, self._bound = scene.near, scene.weight_bound
        self._offset = scene.offset
        self._scale = scene.scale
        self._alpha_scale = scene.alpha_scale
        flags = library().BufferUsage
        storage, n = flags.STORAGE, max(1, self.count)
        self._surfels = self._upload(packed.surfels, storage)
        self._terms = self._upload(packed.terms, storage)
        self._frame = self._empty(FRAME.itemsize, flags.UNIFORM | flags.COPY_DST)
        self._seen = self._empty(SEEN.itemsize * n, storage | flags.COPY_SRC)
        self._keys = [self._empty(4 * n, storage) for _ in range(2)]
        self._order = [self._empty(4 * n, storage | flags.COPY_SRC) for _ in range(2)]
        self._visible = self._empty(4, storage | flags.COPY_DST | flags.COPY_SRC)
        self._draws = self._empty(16 * MOST_LAYERS, storage | flags.INDIRECT)
        numbers = np.zeros((MOST_LAYERS, _STRIDE // 4), np.uint32)
        numbers[:, 0] = np.arange(MOST_LAYERS)
        self._layers = self._upload(numbers, flags.UNIFORM)
        self._atlas, self._atlas_size = self._texture(scene)
        self._detail = 1 if scene.mean_residual is None else 2
        self._coarser: Any = None
        self._target: _Target | None = None
        self._bind()

    def _empty(self, size: int, usage: int) -> Any:
        return self._device.create_buffer(size=size, usage=usage)

    def _upload(self, data: npt.NDArray, usage: int) -> Any:
        if not data.size:
            data = np.zeros(24, np.float32)
        return self._device.create_buffer_with_data(data=np.ascontiguousarray(data), usage=usage)

    def _texture(self, scene: BakedSceneLike) -> tuple[Any, tuple[int, int]]:
        features = self._device.features
        texels, blocks = scene.atlas, scene.blocks
        software = in_software()
        if blocks is not None and "texture-compression-bc" in features and not software:
            return self._pages("bc7-rgba-unorm", blocks.cpu().numpy(), 4)
        if texels is None and blocks is not None:
            texels = decoded(blocks)
            if not software:
                warnings.warn(
                    "the graphics device draws no BC7 textures: the atlas was decoded, at four times the memory",
                    stacklevel=2,
                )
        if texels is None:
            texels = torch.zeros(1, 1, 1, 4, dtype=torch.uint8)
        if texels.dtype == torch.uint8:
            return self._pages("rgba8unorm", texels.cpu().numpy(), 1)
        if "float32-filterable" in features:
            return self._pages("rgba32float", texels.detach().float().cpu().numpy(), 1)
        return self._pages("rgba16float", texels.detach().half().cpu().numpy(), 1)

    def _pages(self, format: str, pages: npt.NDArray, block: int) -> tuple[Any, tuple[int, int]]:
        """Create an array texture from pages [layers, rows of blocks, blocks, ...]."""
        layers, rows, columns = pages.shape[:3]
        size = (columns * block, rows * block, layers)
        check_room(size=size[:2], layers=layers)
        flags = library().TextureUsage
        texture = self._device.create_texture(
            size=size, format=format, usage=flags.TEXTURE_BINDING | flags.COPY_DST, dimension="2d"
        )
        for layer, page in enumerate(pages):
            data = np.ascontiguousarray(page)
            self._device.queue.write_texture(
                {"texture": texture, "origin": (0, 0, layer)},
                data,
                {"bytes_per_row": data.nbytes // rows, "rows_per_image": rows},
                (size[0], size[1], 1),
            )
        return texture, size[:2]

    def _group(self, layout: Any, *resources: Any) -> Any:
        entries = [
            {"binding": k, "resource": {"buffer": r} if hasattr(r, "usage") and hasattr(r, "map_state") else r}
            for k, r in enumerate(resources)
            if r is not None
        ]
        return self._device.create_bind_group(layout=layout, entries=entries)

    def _bind(self) -> None:
        p, blocks = self._programs, -(-max(1, self.count) // BLOCK)
        flags = library().BufferUsage
        table = self._empty(4 * DIGITS * blocks, flags.STORAGE)
        self._prepare = self._group(
            p.prepare.get_bind_group_layout(0),
            *(self._frame, self._surfels, self._terms, self._seen, self._keys[0], self._order[0], self._visible),
        )
        self._rounds, self._blocks = [], blocks
        for k in range(ROUNDS):
            numbers = np.array([self.count, blocks, 4 * k, 0], np.uint32)
            uniform = self._upload(numbers, flags.UNIFORM)
            source, to = k % 2, 1 - k % 2
            buffers = (uniform, self._keys[source], self._order[source], self._keys[to], self._order[to], table)
            used = {"count": (0, 1, 5), "scan": (0, 5), "scatter": (0, 1, 2, 3, 4, 5)}
            self._rounds.append(
                {
                    entry: self._group(
                        p.sort[entry].get_bind_group_layout(0),
                        *(r if i in used[entry] else None for i, r in enumerate(buffers)),
                    )
                    for entry in used
                }
            )
        self._share = self._group(p.share_out.get_bind_group_layout(0), self._frame, self._visible, self._draws)
        self._drawn = self._group(p.layout[0], self._frame, self._surfels, self._seen, self._order[0], self._visible)
        self._bind_pages(self._atlas)

    def _bind_pages(self, coarser: Any) -> None:
        """Bind the atlas and its coarser levels; levels that are not sampled may be any texture."""
        sampler = self._device.create_sampler(mag_filter="linear", min_filter="linear")
        views = [texture.create_view(dimension="2d-array") for texture in (self._atlas, coarser)]
        self._pages_bound = self._group(self._programs.layout[1], views[0], sampler, views[1])

    def _make_coarser(self) -> None:
        """Make the levels 1 and 2 of all pages."""
        format = "rgba8unorm" if self._atlas.format == "bc7-rgba-unorm" else self._atlas.format
        width, height, layers = self._atlas.size
        flags = library().TextureUsage
        size = (max(1, width // 2), max(1, height // 2), layers)
        self._coarser = self._device.create_texture(
            size=size,
            format=format,
            mip_level_count=min(2, max(size[:2]).bit_length()),
            usage=flags.TEXTURE_BINDING | flags.RENDER_ATTACHMENT,
        )
        encoder, p = self._device.create_command_encoder(), self._programs
        pipeline = p.halve(format, self._alpha_scale > 0)
        for level in range(self._coarser.mip_level_count):
            source, at = (self._coarser, level - 1) if level else (self._atlas, 0)
            for layer in range(layers):
                finer, to = (
                    texture.create_view(
                        dimension="2d",
                        base_mip_level=mip,
                        mip_level_count=1,
                        base_array_layer=layer,
                        array_layer_count=1,
                    )
                    for texture, mip in ((source, at), (self._coarser, level))
                )
                attachment = {"view": to, "load_op": "clear", "store_op": "store"}
                work = encoder.begin_render_pass(color_attachments=[attachment])
                work.set_pipeline(pipeline)
                work.set_bind_group(0, self._group(pipeline.get_bind_group_layout(0), finer))
                work.draw(3)
                work.end()
        self._device.queue.submit([encoder.finish()])
        self._bind_pages(self._coarser)

    def _target_of(self, width: int, height: int) -> _Target:
        if self._target is None or self._target.size != (width, height):
            flags = library().TextureUsage
            buffers = library().BufferUsage
            p = self._programs
            size, texel = (width, height, 1), 16 if p.format == "rgba32float" else 8
            check_room(size=(width, height))
            sums = self._device.create_texture(
                size=size, format=p.format, usage=flags.RENDER_ATTACHMENT | flags.COPY_SRC
            )
            copy = self._device.create_texture(size=size, format=p.format, usage=flags.TEXTURE_BINDING | flags.COPY_DST)
            row = -(-texel * width // 256) * 256
            read = self._empty(row * height, buffers.COPY_DST | buffers.MAP_READ)
            layer = {"buffer": self._layers, "offset": 0, "size": 16}
            before = self._group(p.layout[2], layer, copy.create_view())
            self._target = _Target((width, height), (sums, copy), before, read, row)
        return self._target

    def _set_frame(self, camera: CameraLike, show: str, layers: int, photo_pixel: float) -> None:
        viewmat, K = camera.viewmat.cpu().double().numpy(), camera.K.cpu().double().numpy()
        center = camera.exact_center.cpu().double().numpy() - self._origin
        frame = np.zeros(1, FRAME)
        frame["rotation"][0, :, :3] = viewmat[:3, :3]
        lens = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        values = {"center": center, "color_center": center, "lens": lens, "size": (camera.width, camera.height)}
        values |= {"near": self._near, "weight_bound": self._bound, "photo_pixel": photo_pixel, "depth_unit": 1}
        values |= {"offset": self._offset, "scale": self._scale, "alpha_scale": self._alpha_scale}
        values |= {"surfels": self.count, "kind": self._kind, "atlas": self._atlas_size, "layers": layers}
        values |= {"show": SHOW[show], "detail": self._detail, "residuals": 1}
        for name, value in values.items():
            frame[name] = value
        self._device.queue.write_buffer(self._frame, 0, frame)

    def draw(self, camera: CameraLike, show: str, layers: int, photo_pixel: float = 1.0) -> npt.NDArray[np.float32]:
        """Draw a view in `layers` batches, at most `MOST_LAYERS`: [H, W, 4], the sums of `show` (a name of `SHOW`), and
        the remaining transmittance. `photo_pixel`: side of a photograph's pixel in pixels of the view."""
        target = self._target_of(camera.width, camera.height)
        if photo_pixel < 1.0 and self._coarser is None:
            self._make_coarser()
        self._set_frame(camera, show, layers, photo_pixel)
        self._device.queue.write_buffer(self._visible, 0, bytes(4))
        encoder = self._device.create_command_encoder()
        self._encode_sorting(encoder)
        self._encode_drawing(encoder, target, show, layers)
        sums, _ = target.sums
        encoder.copy_texture_to_buffer(
            {"texture": sums},
            {"buffer": target.read, "bytes_per_row": target.row_bytes, "rows_per_image": camera.height},
            (camera.width, camera.height, 1),
        )
        self._device.queue.submit([encoder.finish()])
        return self._read(target)

    def _encode_sorting(self, encoder: Any) -> None:
        p, work = self._programs, encoder.begin_compute_pass()

        def run(pipeline: Any, group: Any, groups: int) -> None:
            work.set_pipeline(pipeline)
            work.set_bind_group(0, group)
            work.dispatch_workgroups(groups)

        run(p.prepare, self._prepare, -(-max(1, self.count) // 64))
        for groups in self._rounds:
            run(p.sort["count"], groups["count"], self._blocks)
            run(p.sort["scan"], groups["scan"], 1)
            run(p.sort["scatter"], groups["scatter"], self._blocks)
        run(p.share_out, self._share, 1)
        work.end()

    def _encode_drawing(self, encoder: Any, target: _Target, show: str, layers: int) -> None:
        p, (sums, copy) = self._programs, target.sums
        pipeline = p.count_fragments if show == "overdraw" else p.blend
        view = sums.create_view()
        for k in range(layers):
            if k:
                encoder.copy_texture_to_texture({"texture": sums}, {"texture": copy}, (*target.size, 1))
            attachment = {"view": view, "load_op": "load" if k else "clear", "store_op": "store"}
            work = encoder.begin_render_pass(color_attachments=[{**attachment, "clear_value": (0, 0, 0, 1)}])
            work.set_pipeline(pipeline)
            work.set_bind_group(0, self._drawn)
            work.set_bind_group(1, self._pages_bound)
            work.set_bind_group(2, target.before, [k * _STRIDE])
            work.draw_indirect(self._draws, 16 * k)
            work.end()

    def _read(self, target: _Target) -> npt.NDArray[np.float32]:
        width, height = target.size
        target.read.map_sync(library().MapMode.READ)
        try:
            raw = np.frombuffer(target.read.read_mapped(), np.uint8).reshape(height, target.row_bytes)
            dtype = np.float32 if self._programs.format == "rgba32float" else np.float16
            used = np.ascontiguousarray(raw[:, : width * 4 * np.dtype(dtype).itemsize])
            return used.view(dtype).reshape(height, width, 4).astype(np.float32)
        finally:
            target.read.unmap()


def draw(
    scene: BakedSceneLike,
    cameras: Sequence[CameraLike],
    background: Tensor | None,
    images: Sequence[str],
    photo_pixel: float = 1.0,
    layers: int = LAYERS,
) -> dict[str, Tensor]:
    """Draw views one by one to the CPU, as `baked.draw`. Raises WebGpuUnavailable: the package wgpu or a graphics
    device is missing."""
    texels = (scene.tiles, scene.atlas, scene.blocks, scene.extent, scene.mean_residual, scene.mean_alpha)
    numbers = f"webgpu {scene.near} {scene.weight_bound} {scene.offset} {scene.scale} {scene.alpha_scale}"
    there = scene.cache.atlas(lambda: SceneOnDevice(scene), *scene.surfels.values(), *texels, numbers)
    drawn: dict[str, list[Tensor]] = {name: [] for name in images}
    for camera in cameras:
        sums = {
            show: torch.from_numpy(there.draw(camera, show, layers, photo_pixel))
            for show in {_FROM[name][0] for name in images}
        }
        for name, views in drawn.items():
            show, channels = _FROM[name]
            view = sums[show][..., channels]
            if name == "alpha":
                view = 1 - view
            elif name == "overdraw":
                view = view.round().int()
            elif name == "rgb" and background is not None:
                view = view + sums[show][..., 3:4] * background.detach().float().cpu()
            views.append(view.contiguous())
    return {name: torch.stack(views) for name, views in drawn.items()}
