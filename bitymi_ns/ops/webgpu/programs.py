"""Shader programs: assembled and compiled."""

import functools
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any

from .device import device, library

PARTS = {
    "prepare": ("scene", "view_color", "resize", "bounds", "prepare"),
    "sort": ("sort",),
    "share_out": ("scene", "batches", "share_out"),
    "draw": ("scene", "batches", "resize", "draw"),
    "halve": ("halve",),
}
"""Files of each program, in order."""


@functools.cache
def shader(program: str) -> Any:
    """Compile a program of `PARTS` for the device of this process."""
    folder = resources.files("bitymi_ns.ops") / "shaders"
    code = "\n".join((folder / f"{part}.wgsl").read_text("utf8") for part in PARTS[program])
    return device().create_shader_module(label=program, code=code)


def _compute(program: str, entry: str) -> Any:
    return device().create_compute_pipeline(
        label=entry, layout=library().AutoLayoutMode.auto, compute={"module": shader(program), "entry_point": entry}
    )


@dataclass
class Programs:
    """Pipelines for the device of this process."""

    format: str  # of the render target

    @cached_property
    def prepare(self) -> Any:
        return _compute("prepare", "prepare")

    @cached_property
    def sort(self) -> dict[str, Any]:
        return {entry: _compute("sort", entry) for entry in ("count", "scan", "scatter")}

    @cached_property
    def share_out(self) -> Any:
        return _compute("share_out", "share_out")

    @cached_property
    def layout(self) -> list[Any]:
        """Bind group layouts of `draw`: scene and frame, atlas, batch."""
        wgpu = library()
        vertex, fragment = wgpu.ShaderStage.VERTEX, wgpu.ShaderStage.FRAGMENT

        def group(*resources: tuple[int, dict[str, Any]]) -> Any:
            entries = [{"binding": k, "visibility": seen, **of} for k, (seen, of) in enumerate(resources)]
            return device().create_bind_group_layout(entries=entries)

        # the binding declares whether the target's format can be filtered
        filters = self.format != "rgba32float" or "float32-filterable" in device().features
        before = {"sample_type": "float" if filters else "unfilterable-float"}
        atlas = {"texture": {"sample_type": "float", "view_dimension": "2d-array"}}
        batch = {"type": "uniform", "has_dynamic_offset": True, "min_binding_size": 16}
        arrays = [(vertex, {"buffer": {"type": "read-only-storage"}})] * 4
        return [
            group((vertex | fragment, {"buffer": {"type": "uniform"}}), *arrays),
            group((fragment, atlas), (fragment, {"sampler": {"type": "filtering"}}), (fragment, atlas)),
            group((vertex | fragment, {"buffer": batch}), (fragment, {"texture": before})),
        ]

    def _draw(self, color: dict[str, str]) -> Any:
        transmittance = {"operation": "add", "src_factor": "zero", "dst_factor": "one-minus-src-alpha"}
        module = shader("draw")
        return device().create_render_pipeline(
            layout=device().create_pipeline_layout(bind_group_layouts=self.layout),
            vertex={"module": module, "entry_point": "corner"},
            primitive={"topology": "triangle-strip"},
            fragment={
                "module": module,
                "entry_point": "surfel",
                "targets": [{"format": self.format, "blend": {"color": color, "alpha": transmittance}}],
            },
        )

    @cached_property
    def blend(self) -> Any:
        """Pipeline that adds a fragment times the transmittance in front of it."""
        return self._draw({"operation": "add", "src_factor": "dst-alpha", "dst_factor": "one"})

    @cached_property
    def count_fragments(self) -> Any:
        """Pipeline that adds fragments unweighted."""
        return self._draw({"operation": "add", "src_factor": "one", "dst_factor": "one"})

    def halve(self, format: str, alpha: bool) -> Any:
        """Pipeline that halves a page into a target of this format, with `alpha` weighting colours by it."""
        entry = f"halve{'_alpha' if alpha else ''}_{'bytes' if format == 'rgba8unorm' else 'floats'}"
        module = shader("halve")
        return device().create_render_pipeline(
            layout=library().AutoLayoutMode.auto,
            vertex={"module": module, "entry_point": "page"},
            primitive={"topology": "triangle-list"},
            fragment={"module": module, "entry_point": entry, "targets": [{"format": format}]},
        )
