"""Options of the export for compact bundles."""

from __future__ import annotations

from dataclasses import dataclass

from bitymi_ns.bake.codes import Codes
from bitymi_ns.bake.compact import Compact
from bitymi_ns.bake.precision import PrecisionOptions
from bitymi_ns.bake.texel_codes import TexelCodeOptions
from bitymi_ns.bundle.compact import pack_surfels
from bitymi_ns.host.errors import fail

SURFEL_SHARE = 0.45
"""Of the bytes that were asked for, that surfels may take."""
MANIFEST_BYTES = 20_000
"""Of bundle.json and config.yml, at most about."""
LEAST_TEXEL_BYTES = 1000


@dataclass(kw_only=True)
class CompactOptions:
    """What a compact bundle is like."""

    compact: bool = False
    """Write a compact bundle (version 3): surfels rounded as far as the pictures allow, texels by cosine transform.
    `format` and `bc7_profile` then decide nothing."""
    interchange: bool = False
    """Write surfels.ply into a compact bundle, too, for other programs."""
    surfel_error: float = PrecisionOptions.share
    """How much the rounding of the surfels of a compact bundle may add to the mean square error against the training
    photographs, as a share of it, before the texels are tuned."""
    texel_step: float = TexelCodeOptions.step
    """How coarse the texels of a compact bundle are: the step of a coefficient, in 8-bit steps, of texels that make up
    one pixel of the training views each."""
    target_mb: float | None = None
    """Bytes of a compact bundle, in MB (10^6): surfels and texels become as coarse as it takes."""

    def check_compact(self, tolerance: float) -> None:
        """Stops where an option is out of its range, or does not fit the tolerance of the bake."""
        if self.compact and tolerance == 0:
            fail("a compact bundle needs a tolerance (--compact with --exact or --tolerance 0)")
        if self.interchange and not self.compact:
            fail("--interchange adds surfels.ply to a compact bundle; another one has it (--compact)")
        if self.target_mb is not None and (not self.compact or not 0.01 <= self.target_mb <= 1e5):
            fail(f"--target-mb is for a compact bundle (--compact) and from 0.01 to 100,000 MB, not {self.target_mb}")
        try:
            self._precision().check()
            TexelCodeOptions(step=self.texel_step).check()
        except ValueError as error:
            fail(f"the bundle cannot be made compact: {error} (--surfel-error, --texel-step)", error)

    def compact_of(self, beside: int) -> Compact | None:
        """How the bake is made compact; None = it is not.

        Args:
            beside: bytes of other files, such as the preview.
        """
        if not self.compact:
            return None

        def left(codes: Codes) -> int | None:
            """Bytes of the target that are left for the texels."""
            if self.target_mb is None:
                return None
            _, surfels = pack_surfels(codes.surfels, codes.residual, codes.residual_step)
            bytes_left = int(1e6 * self.target_mb) - len(surfels) - beside - MANIFEST_BYTES
            if bytes_left < LEAST_TEXEL_BYTES:
                fail(
                    f"a bundle of {self.target_mb} MB leaves no bytes for the texels, as the surfels take "
                    f"{len(surfels):,} and other files {beside + MANIFEST_BYTES:,}: ask for more (--target-mb), or "
                    "train with fewer surfels"
                )
            return bytes_left

        return Compact(self._precision(), TexelCodeOptions(step=self.texel_step), left)

    def _precision(self) -> PrecisionOptions:
        most = None if self.target_mb is None else int(SURFEL_SHARE * 1e6 * self.target_mb)
        return PrecisionOptions(share=self.surfel_error, most_bytes=most)
