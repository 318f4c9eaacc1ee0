"""`ns-export bitymi-atlas`: bake a trained scene into a bundle, and measure the loss."""

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import Field

from bitymi_ns import exit_messages
from bitymi_ns.bake import BakeOptions, RefineOptions, TuneOptions, bake, export
from bitymi_ns.bake.compact import Compact
from bitymi_ns.bake.pipeline import FEWEST_PASSES
from bitymi_ns.bundle import BundleError, reserved_bundle
from bitymi_ns.bundle.parts import CONFIG
from bitymi_ns.interchange.extras import (
    Frame,
    Kind,
    extras_folder,
    removal_line,
    reserve_extras,
    summary_line,
    write_extras,
)
from bitymi_ns.progress import rich_progress
from bitymi_ns.ranges import Count, check_ranges
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.exposure import corrected
from ..console import INTERRUPTED, fail, say, warn
from ..data.cameras import to_cameras
from ..run.memory import state_export
from .summary import print_summary
from .target import bundle_config, bundle_version, check_room
from .trained import camera_files, compare, load_trained, preview, world_of


@dataclass(kw_only=True)
class ExportAtlas(BakeOptions):
    """Bake a trained bitymi scene into a bundle: surfels, a compressed texture atlas and a manifest; compare it with
    the trained scene and the photographs on the held-out views."""

    load_config: Path  # config.yml of a trained scene.
    output_dir: Path  # Folder of the bundle.
    overwrite: bool = False  # Replace an existing bundle.
    exact: bool = False
    """Keep everything: tiles at the field's Nyquist rate, not capped by the training views; unseen surfels; all sites
    of view colours; texels as trained or sampled, without fine-tuning."""
    polish_steps: Count | None = None
    """Steps in which texels, geometry, opacities and view colours learn together from the training photographs, before
    tiles and view colours are reduced; 0 = none. Not given: 0 if texels learned in training, and on a GPU, which lacks
    kernels for it; else 300, or 4 per photograph if more."""
    finetune_steps: Count | None = None
    """Steps of fine-tuning texels alone, after the polish; 0 = none. Not given: 400 without a polish, 100 after one,
    each with 120 more on texels as stored; only 100 on stored texels if texels learned in training."""
    finetune_memory: Annotated[float, Field(ge=0, le=1e6)] = TuneOptions.cache_bytes / 1e9
    """GB of memory for traced views; changes the time of fine-tuning alone."""
    compare: bool = True  # State the difference from the trained scene in the held-out views.

    extras: tuple[Kind, ...] = ()
    """Also write the scene for other programs, into a folder of the bundle's name and .extras: gaussians (a preview as
    Gaussian splats), surfels (with two scales), usd (OpenUSD's surflets), mesh (textured quads). `bitymi extras BUNDLE`
    does so later."""
    extras_frame: Frame = "scene"  # Frame of these files: the scene's, or the capture's own.
    check_room: bool = True
    """Stop if the disk may have too little room, by an estimate that can be far too high."""
    photographs: bool = False  # Put the held-out photographs into the bundle.
    interchange: bool = False  # Write surfels.ply into a compact bundle, too.
    compact_error: Annotated[float, Field(gt=0, lt=1)] = Compact.share
    """Share by which compacting may raise the mean square error against the training photographs, before texels are
    tuned; less if texels would become too coarse to learn."""
    target_mb: float | None = None
    """Largest size of a compact bundle in MB (10^6 bytes), instead of compact_error; smaller if the photographs are
    shown as well, to 0.01 dB."""
    target_psnr: Annotated[float, Field(ge=1, le=100)] | None = None
    """PSNR in dB against the training photographs before texels are tuned, instead of compact_error: the smallest
    bundle that reaches it is made."""

    def main(self) -> None:
        exit_messages.install()
        reserved, earlier = False, None
        bake_options = self._options()
        try:
            with reserved_bundle(self.output_dir, self.overwrite, warn, " (--output-dir)"):
                reserved, earlier = True, bundle_version(self.output_dir)
                if self.extras:
                    reserve_extras(self.extras, extras_folder(self.output_dir), self.overwrite)
                if self.check_room:
                    check_room(self.output_dir, self.load_config, bake_options, self.exact)
                self._run(bake_options)
        except KeyboardInterrupt:
            there = bundle_version(self.output_dir)
            unwritten = not reserved or there == earlier
            state = "was not written" if there is None else "is the earlier one" if unwritten else "is complete"
            warn(f"The export was interrupted; the bundle {self.output_dir} {state}.")
            raise SystemExit(INTERRUPTED) from None
        except BundleError as error:
            fail(str(error), error)

    def _options(self) -> BakeOptions:
        """Build the bake's options; stop if one is out of range."""
        options = BakeOptions(**{f.name: getattr(self, f.name) for f in fields(BakeOptions)})
        if self.exact:
            options = replace(options, tolerance=0.0, cap_by_views=False, drop_unseen=False)
        try:
            check_ranges(self)
        except ValueError as error:
            name, _, rule = str(error).partition(" ")
            fail(f"--{name.replace('_', '-')} {rule}", error)
        try:
            options.check()
        except (ValueError, RuntimeError) as error:  # the BC7 encoder may be missing
            fail(f"the scene cannot be baked: {error}", error)
        for name in ("interchange", "compact_error", "target_mb", "target_psnr"):
            if options.bundle_format != "compact" and getattr(self, name) != getattr(ExportAtlas, name):
                fail(f"--{name.replace('_', '-')} is for --format compact, not {options.bundle_format}")
        self._compact(0)
        if self.target_mb is not None and self.target_psnr is not None:
            fail("--target-mb and --target-psnr cannot be combined: leave one out")
        return options

    def _compact(self, beside: int) -> Compact:
        """Build the options of the compact bake; `beside`: bytes of the bundle's other files."""
        compact = Compact(self.compact_error, psnr=self.target_psnr)
        try:
            return compact if self.target_mb is None else compact.fitting(self.target_mb, beside)
        except ValueError as error:
            fail(f"{error}; correct --target-mb", error)

    def _run(self, options: BakeOptions) -> None:
        config, pipeline = load_trained(self.load_config)
        model, datamanager = pipeline.model, pipeline.datamanager
        views = to_cameras(datamanager.train_dataset.cameras, model.device)
        compact = options.bundle_format == "compact"
        first = datamanager.eval_views[0].camera if len(datamanager.eval_dataset) else views[0]
        shown = preview(model, first, "JPEG" if compact else "PNG")
        exposure = model.resume_state.get("exposure")
        cameras_of = camera_files(datamanager, views, self.photographs, exposure)
        beside = len(shown) + sum(map(len, cameras_of.values()))
        compacting = self._compact(beside) if compact else None
        refine, memory = RefineOptions(), int(self.finetune_memory * 1e9)
        if not self.exact:
            steps = (self.polish_steps, self.finetune_steps, memory)
            refine = RefineOptions.for_scene(model.scene, len(views), *steps, model.train_config, compacting)
        polish = refine.polish
        tune = refine.tune
        has_learned = isinstance(model.scene.field, TexelField)
        for name, options_of in (("polish", polish), ("finetune", None if polish or has_learned else tune)):
            if options_of is not None and options_of.steps < FEWEST_PASSES * len(views):
                each = f"{len(views):,} training photographs, {options_of.steps / len(views):.1f} for each"
                say(f"The {name} has {options_of.steps:,} steps for {each}: more may gain (--{name}-steps).")
        kept = tune.cache_bytes if tune else 0
        learning_surfels = len(model.scene) if polish else 0
        state_export(model.scene, views, kept, learning_surfels, compact)
        try:
            with rich_progress() as progress:
                held_out = datamanager.corrected_eval_views(exposure) if self.compare else ()
                background = model.background.cpu()
                photographs = datamanager.train_views
                if polish or tune or refine.compact:
                    photographs = corrected(photographs, exposure, datamanager.train_dataset.facts.files)
                learned = (options, refine, progress, held_out)
                baked = bake(model.scene, views, photographs, background, *learned)
        except (ValueError, RuntimeError) as error:
            fail(f"the scene cannot be baked: {exit_messages.line_of(error) or error}", error)
        background = tuple(model.background.tolist())
        written = {
            "statistics": {"options": asdict(baked.options), "method": config.method_name},
            "extra_files": {"preview.jpg" if compact else "preview.png": shown, **cameras_of},
            "loose_files": {CONFIG: bundle_config(config, self.output_dir, background)},
        }
        how = {"overwrite": self.overwrite, "interchange": self.interchange, "first": first, "background": background}
        try:
            if self.compare and len(datamanager.eval_dataset):
                written["statistics"]["held_out"] = compare(model, datamanager, baked.scene).model_dump()
        finally:  # an interrupted comparison leaves the bundle, without its result
            bundle = export(baked, self.output_dir, world=world_of(datamanager), **written, **how)
        print_summary(self.output_dir, baked, bundle.info, self.target_mb)
        if self.extras:
            folder = extras_folder(self.output_dir)
            how = {"frame": self.extras_frame, "overwrite": self.overwrite}
            how |= {"cameras": [camera.to("cpu") for camera in views]}
            removed = removal_line(self.extras, folder)
            with rich_progress() as progress:
                written = write_extras(bundle, folder, self.extras, progress=progress, **how)
            for entry in written.values():
                say(f"In {folder}: {summary_line(entry)}")
            if removed:
                say(removed)


def main() -> None:
    tyro.cli(tyro.conf.FlagConversionOff[ExportAtlas]).main()


if __name__ == "__main__":
    main()
