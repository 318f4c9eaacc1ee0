"""Options of a scene's parameters and rendering."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from bitymi_ns.ops.constants import MAX_LEVELS, MAX_TERMS
from bitymi_ns.ops.view_kinds import Kind
from bitymi_ns.ranges import Count, Share

Texture = Literal["hash", "texels", "none"]  # residual colour, added to the view-dependent colour


@dataclass
class SceneConfig:
    """Representation of the scene: surfels, view-dependent colour and residual colour."""

    view_color: Kind = "sv"
    """View colour: sv = Spherical Voronoi, sh = spherical harmonics, sb = Spherical Beta, sg = spherical Gaussians."""
    sv_sites: Annotated[int, Field(ge=1, le=MAX_TERMS)] = 7
    """Number of Spherical Voronoi sites per surfel (the paper's K), 1 to 32."""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics, 0 to 3."""
    lobes: Annotated[int, Field(ge=1, le=MAX_TERMS)] = 2
    """Number of lobes per surfel of the Spherical Beta and spherical Gaussian colours, 1 to 32."""
    texture: Texture = "hash"
    """Residual colours: hash = a field in space (hash grid and MLP); texels = texels on every surfel, trained in the
    last part of the run (train.texels); none = no residual."""
    levels: Annotated[int, Field(ge=1, le=MAX_LEVELS)] = 4
    """Hash grid levels, 1 to 4, with resolutions min_resolution * 2^level; the paper's 4."""
    min_resolution: Annotated[int, Field(ge=2, le=1 << 20)] = 256
    """Cells along an edge of the coarsest hash grid level, 2 to 2^20."""
    log2_table_size: Annotated[int, Field(ge=1, le=24)] | None = None
    """Entries per hash level, as a power of two, 1 to 24; not given: chosen by the number of pixels in the photographs,
    so that the table fits the cache."""
    contraction: Literal["auto", "on", "off"] = "auto"
    """Contraction of space beyond the cameras; auto: off for images with alpha and captures with a small scene box."""
    near: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None
    """Near plane, in scene units (camera z), above 0; not given: 0.02 of the extent of the cameras."""
    weight_bound: Share = 0.02
    """Blending weight below which fragments have no residual colour; 0 to 1."""
    texture_moves_surfels: bool = False
    """Let the gradient of the residual field with respect to position reach the surfels; that of texels always does."""
    max_fragments: Count = 0
    """Maximum number of fragments in memory. Views with more are rendered in bands, which the backward pass renders
    again. 0: on a GPU as many as its memory holds, on the CPU 2^25, which take 1.5 GB."""
    rim: Annotated[float, Field(ge=1e-8, le=1)] = 1e-3
    """Lower bound of 1 - x in the derivative of the Beta kernel, which diverges at the rim for beta < 1; 1e-8 to 1."""
