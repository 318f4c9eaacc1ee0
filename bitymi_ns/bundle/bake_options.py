"""Options of the bake, recorded in bundle.json."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pydantic import Field

from bitymi_ns.codec.bc7_encode import Profile, bc7_encoder
from bitymi_ns.codec.limits import EXTENTS
from bitymi_ns.codec.packing import check_page
from bitymi_ns.codec.quantise import STEPS, Format, RangeRule
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.tile_sizes import check_sides

BundleFormat = Literal["compact", Format]


@dataclass
class BakeOptions:
    """Options of the bake: bundle format, tolerance, tiles."""

    format: BundleFormat | None = None
    """compact: surfels and view colours quantised as far as the pictures allow, texels by cosine transform; a sixth to
    a half of the bytes of bc7: surfels.ply and texels of 1 byte. uint8, fp16: texels of 4 and 8 bytes. None: compact,
    or bc7 for a tolerance of 0."""
    bc7_profile: Profile = "veryfast"
    """Effort of the BC7 encoder; basic and slow gain about 0.3 dB at a quarter and a twelfth of the speed."""
    r_min: int = 4
    """Smallest tile side in texels, a power of two of at least 4."""
    r_max: int = 64
    """Largest tile side in texels, a power of two."""
    extent: Annotated[float, Field(ge=EXTENTS[0], le=EXTENTS[1])] = SUPPORT
    """Largest half side of a tile in scale units (the paper's e, 4 there); 3 is the kernel's support. With a tolerance
    a tile covers only fragments above the weight bound."""
    tolerance: Annotated[float, Field(ge=0, lt=STEPS)] = 0.75
    """Largest error of the reduction, in 8-bit steps, weighted by a fragment's largest contribution to a pixel: root
    mean square over the visible part of a tile, which takes the smallest grid, or none; largest over the directions of
    a view colour, which keeps the fewest Spherical Voronoi sites, or one colour (other kinds: everything or one
    colour). 0: tile sizes by the Nyquist rule, view colours unchanged."""
    local_voxel: bool = True
    """Choose a tile's size by the field's voxels at the surfel; False: by the scene's smallest, as in the paper."""
    cap_by_views: bool = True
    """Limit the texels of a tile to the pixels it covers in the training view that sees it largest."""
    drop_unseen: bool = True
    """Drop surfels that no training view blends (if views are given)."""
    range: RangeRule = "sigma6"
    """Quantisation range: sigma6 = mean +- 6 standard deviations, minmax = no clipping, auto = the smaller error."""
    range_samples: Annotated[int, Field(ge=1)] = 1 << 18
    """Texels in the bootstrap sample for the range."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of that sample."""
    page_width: int = 4096
    """Width of an atlas page in texels, a power of two; small atlases get narrower pages."""
    page_rows: int = 8192
    """Largest height of an atlas page; phones and WebGPU stop at 8192."""
    chunk: Annotated[int, Field(ge=1)] = 1 << 18
    """Texels evaluated at once."""

    @property
    def bundle_format(self) -> BundleFormat:
        """Format of the bundle, with the default resolved."""
        return self.format or ("compact" if self.tolerance > 0 else "bc7")

    @property
    def texel_format(self) -> Format:
        """Format of the atlas in memory: compact texels are decoded to 8 bits."""
        return "uint8" if self.bundle_format == "compact" else self.bundle_format

    def check(self) -> None:
        """Raise ValueError: an option is out of its range; RuntimeError: the BC7 encoder is not installed."""
        formats = get_args(BundleFormat)
        if self.bundle_format not in formats:
            raise ValueError(f"there is no format {self.format!r}: choose among {', '.join(formats)}")
        check_ranges(self)
        check_sides(self.r_min, self.r_max)
        check_page(self.page_width, self.page_rows)
        if self.r_max > self.page_width or self.page_rows % self.r_max:
            raise ValueError(
                f"tiles of r_max = {self.r_max} texels do not fit pages of {self.page_width} x {self.page_rows} texels"
            )
        if self.format == "compact" and self.tolerance == 0:
            raise ValueError("a compact bundle needs a tolerance above 0: choose another format or tolerance")
        if self.texel_format == "bc7":
            bc7_encoder(self.bc7_profile)
        elif self.bc7_profile != BakeOptions.bc7_profile:
            raise ValueError(f"bc7_profile is for the format bc7, and this bundle's is {self.bundle_format}")
