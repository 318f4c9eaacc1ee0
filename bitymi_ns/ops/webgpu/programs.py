"""Shader programs: assembled and compiled for a device."""

from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any

from .device import library

PARTS = {
    "prepare": ("scene", "view_color", "resize", "bounds", "prepare"),
    "sort": ("sort",),
    "share_out": ("scene", "batches", "share_out"),
    "draw": ("scene", "batches", "resize", "draw"),
    "halve": ("halve",),
}
"""Files of each program, in order."""


def source(program: str) -> str:
    """Assemble the source of a program of `PARTS`."""
    folder = resources.files("bitymi_ns.ops") / "shaders"
    return "\n".join((folder / f"{part}.wgsl").read_text("utf8") for part in PARTS[program])


@dataclass
class Programs:
    """Pipelines for a device."""

    device: Any  # from `device.device`
    format: str  # of the render target

    def _module(self, name: str) -> Any:
        return self.device.create_shader_module(label=name, code=source(name))

    def _compute(self, module: Any, entry: str) -> Any:
        return self.device.create_compute_pipeline(
            label=entry, layout=library().AutoLayoutMode.auto, compute={"module": module, "entry_point": entry}
        )

    @cached_property
    def prepare(self) -> Any:
        return self._compute(self._module("prepare"), "prepare")

    @cached_property
    def sort(self) -> dict[str, Any]:
        module = self._module("sort")
        return {entry: self._compute(module, entry) for entry in ("count", "scan", "scatter")}

    @cached_property
    def share_out(self) -> Any:
        return self._compute(self._module("share_out"), "share_out")

    @cached_property
    def _draw_module(self) -> Any:
        return self._module("draw")

    @cached_property
    def layout(self) -> list[Any]:
        """Bind group layouts of `draw`: scene and frame, atlas, batch."""
        wgpu = library()
        vertex, fragment = wgpu.ShaderStage.VERTEX, wgpu.ShaderStage.FRAGMENT

        def group(*resources: tuple[int, dict[str, Any]]) -> Any:
            entries = [{"binding": k, "visibility": seen, **of} for k, (seen, of) in enumerate(resources)]
            return self.device.create_bind_group_layout(entries=entries)

        # the binding declares whether the target's format can be filtered
        filters = self.format != "rgba32float" or "float32-filterable" in self.device.features
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
        module = self._draw_module
        return self.device.create_render_pipeline(
            layout=self.device.create_pipeline_layout(bind_group_layouts=self.layout),
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

    @cached_property
    def _halve_module(self) -> Any:
        return self._module("halve")

    def halve(self, format: str, alpha: bool) -> Any:
        """Build the pipeline that halves a page into a target of this format, with `alpha` weighting colours by it."""
        entry = f"halve{'_alpha' if alpha else ''}_{'bytes' if format == 'rgba8unorm' else 'floats'}"
        module = self._halve_module
        return self.device.create_render_pipeline(
            layout=library().AutoLayoutMode.auto,
            vertex={"module": module, "entry_point": "page"},
            primitive={"topology": "triangle-list"},
            fragment={"module": module, "entry_point": entry, "targets": [{"format": format}]},
        )
