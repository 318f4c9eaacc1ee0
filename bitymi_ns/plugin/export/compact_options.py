"""Options of the export that say what a bundle is stored as."""

from dataclasses import dataclass
from typing import Literal

from bitymi_ns.bake.compact import Compact
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.poster import most_bytes
from bitymi_ns.plugin.console import fail, say

BundleFormat = Literal["compact", "bc7", "uint8", "fp16"]
_MUCH_SMALLER = 0.9
MANIFEST_BYTES = 28_000  # upper estimate of bundle.json and config.yml


@dataclass(kw_only=True)
class CompactOptions:
    """Size and quality of a compact bundle."""

    interchange: bool = False
    """Write surfels.ply into a compact bundle, too, for other programs; those of other formats have it."""
    compact_error: float = Compact.share
    """Share by which compacting may raise the mean square error against the training photographs,
    before the texels are tuned; less where texels would then be too coarse to learn. The bytes go where they save most
    of it: to surfels, view colours or texels."""
    target_mb: float | None = None
    """Bytes of a compact bundle, in MB (10^6), in the place of compact_error: everything becomes as coarse as it
    takes. Where fewer bytes show the photographs as well, to 0.01 dB, these are taken."""
    target_psnr: float | None = None
    """PSNR in dB against the training photographs, before the texels are tuned, in the place of compact_error:
    everything becomes as coarse as it may. Held-out views are shown less well than these."""

    def check_compact(self, form: BundleFormat, tolerance: float, bc7_profile: str) -> None:
        """Stop where an option is out of its range, or is for another format than that of the bundle.

        Args:
            form: format of the bundle.
            tolerance: of the bake.
            bc7_profile: that was asked for.
        """
        compact = form == "compact"
        if compact and tolerance == 0:
            fail("a compact bundle needs a tolerance: leave out --format compact, or --exact and --tolerance 0")
        if form != "bc7" and bc7_profile != BakeOptions.bc7_profile:
            fail(f"--bc7-profile is for --format bc7, and this bundle's is {form}")
        for name in ("interchange", "compact_error", "target_mb", "target_psnr"):
            if not compact and getattr(self, name) != getattr(CompactOptions, name):
                fail(f"--{name.replace('_', '-')} is for --format compact, and this bundle's is {form}")
        if self.target_mb is not None and not 0.01 <= self.target_mb <= 1e5:
            fail(f"--target-mb must be from 0.01 to 100,000 MB, not {self.target_mb}")
        if self.target_psnr is not None and not 1 <= self.target_psnr <= 100:
            fail(f"--target-psnr must be from 1 to 100 dB, not {self.target_psnr}")
        if self.target_mb is not None and self.target_psnr is not None:
            fail("--target-mb and --target-psnr cannot be asked for together: leave one out")
        if not 0 < self.compact_error < 1:
            fail(f"--compact-error must lie between 0 and 1, not at {self.compact_error}")

    def state_size(self, written: int) -> None:
        """Print a note where the bundle is much smaller than --target-mb."""
        if self.target_mb is not None and written < _MUCH_SMALLER * 1e6 * self.target_mb:
            say(
                f"{written / 1e6:.2f} MB suffice, of the {self.target_mb:g} MB that were asked for: with more, the "
                "training photographs are shown no better by 0.01 dB."
            )

    def compact_of(self, beside: int) -> Compact:
        """Make the options of the compact bake.

        Args:
            beside: bytes of other files, such as the preview.
        """
        most = None
        if self.target_mb is not None:
            beside += MANIFEST_BYTES + most_bytes(int(1e6 * self.target_mb))
            most = int(1e6 * self.target_mb) - beside
            if most < 1:
                fail(
                    f"a bundle of {self.target_mb} MB leaves no bytes for the scene, as other files take "
                    f"{beside:,}: ask for more (--target-mb)"
                )
        return Compact(self.compact_error, most, self.target_psnr)
