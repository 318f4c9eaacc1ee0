"""Options of the export for compact bundles."""

from __future__ import annotations

from dataclasses import dataclass

from bitymi_ns.bake.compact import Compact
from bitymi_ns.host.errors import fail

MANIFEST_BYTES = 28_000
"""Of bundle.json and config.yml, at most about."""


@dataclass(kw_only=True)
class CompactOptions:
    """What a compact bundle is like."""

    compact: bool = False
    """Write a compact bundle (version 3): surfels and view colours as far as the pictures need them, texels by cosine
    transform. `format` and `bc7_profile` then decide nothing."""
    interchange: bool = False
    """Write surfels.ply into a compact bundle, too, for other programs."""
    compact_error: float = Compact.share
    """How much making it compact may add to the mean square error against the training photographs, as a share of it,
    before the texels are tuned; less where texels would then be too coarse to learn. The bytes go where they save most
    of it: to surfels, view colours or texels."""
    target_mb: float | None = None
    """Bytes of a compact bundle, in MB (10^6), in the place of compact_error: everything becomes as coarse as it
    takes."""
    target_psnr: float | None = None
    """PSNR in dB against the training photographs, before the texels are tuned, in the place of compact_error:
    everything becomes as coarse as it may. Held-out views are shown less well than these."""

    def check_compact(self, tolerance: float) -> None:
        """Stops where an option is out of its range, or does not fit the tolerance of the bake."""
        if self.compact and tolerance == 0:
            fail("a compact bundle needs a tolerance (--compact with --exact or --tolerance 0)")
        if self.interchange and not self.compact:
            fail("--interchange adds surfels.ply to a compact bundle; another one has it (--compact)")
        if self.target_mb is not None and (not self.compact or not 0.01 <= self.target_mb <= 1e5):
            fail(f"--target-mb is for a compact bundle (--compact) and from 0.01 to 100,000 MB, not {self.target_mb}")
        if self.target_psnr is not None and (not self.compact or not 1 <= self.target_psnr <= 100):
            fail(f"--target-psnr is for a compact bundle (--compact) and from 1 to 100 dB, not {self.target_psnr}")
        if self.target_mb is not None and self.target_psnr is not None:
            fail("--target-mb and --target-psnr cannot be asked for together: leave one out")
        if not 0 < self.compact_error < 1:
            fail(f"--compact-error must lie between 0 and 1, not at {self.compact_error}")

    def compact_of(self, beside: int) -> Compact | None:
        """How the bake is made compact; None = it is not.

        Args:
            beside: bytes of other files, such as the preview.
        """
        if not self.compact:
            return None
        most = None
        if self.target_mb is not None:
            most = int(1e6 * self.target_mb) - beside - MANIFEST_BYTES
            if most < 1:
                fail(
                    f"a bundle of {self.target_mb} MB leaves no bytes for the scene, as other files take "
                    f"{beside + MANIFEST_BYTES:,}: ask for more (--target-mb)"
                )
        return Compact(self.compact_error, most, self.target_psnr)
