"""Subcommands of the `bitymi` console script."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Literal, TextIO

import tyro

from . import exit_messages
from .capture.types import SfmOptions
from .errors import KernelsUnavailable
from .files import write_errors_as
from .measure.bench.cli import BenchRun
from .trust import listed, printable


def say(text: object, to: TextIO | None = None) -> None:
    """Print a line and flush, with control characters escaped."""
    print(printable(str(text)), file=to or sys.stdout, flush=True)


# without the --no- form, if tyro supports it
Flag = tyro.conf.FlagCreatePairsOff[bool] if hasattr(tyro.conf, "FlagCreatePairsOff") else bool


@dataclass
class Sample:
    """Ray-trace a small room and write it as a nerfstudio capture: images, exact cameras and sparse points."""

    output_dir: Path  # Folder to write; missing or empty.
    views: int = 60  # Number of images.
    width: int = 320  # Image width in pixels.
    height: int = 240  # Image height in pixels.
    seed: int = 0  # Seed of textures, camera path and points.
    points: int = 8000  # Number of sparse points.
    overwrite: Flag = False  # Replace the folder if it holds something.

    def run(self) -> None:
        from . import sample
        from .progress import rich_progress

        with write_errors_as(self.output_dir, ValueError), rich_progress() as progress:
            folder = sample.generate(**vars(self), progress=progress)
        say(f"Wrote {self.views} images and {self.points} points to {folder}")


@dataclass
class Sfm:
    """Find the camera poses of photographs or of a video; write a COLMAP model and a nerfstudio capture."""

    source: tyro.conf.Positional[Path]  # Folder of photographs (or of `images` and `masks`), or a video.
    output: Path | None = None
    """Folder to write the capture to; none = keep the poses beside the photographs, and print their folder."""
    options: tyro.conf.OmitArgPrefixes[SfmOptions] = SfmOptions()

    def run(self) -> None:
        from .capture.frame import gps_line
        from .capture.nerfstudio import write_capture
        from .capture.poses import find_poses
        from .progress import rich_progress

        with rich_progress() as progress:
            poses = find_poses(self.source, self.options, progress, lambda text: say(text, sys.stderr))
            if self.output is not None:
                with write_errors_as(self.output, ValueError):
                    write_capture(poses, self.output, progress)
        for name, why in poses.left_out.items():
            say(f"left out: {name}: {why}")
        say(
            f"{poses.registered} of {poses.given} photographs have a pose; mean reprojection error "
            f"{poses.reprojection_error:.2f} pixels. Report: {(self.output or poses.report) / 'report.json'}"
        )
        if by_gps := gps_line(poses.report):
            say(by_gps)
        if poses.doubt:
            say(poses.doubt, sys.stderr)
        say(f"Wrote {self.output}" if self.output else f"COLMAP model: {poses.model}")


@dataclass
class Report:
    """Turn ns-eval results and training logs into one page: tables and plots of error against time."""

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """JSON files of ns-eval, cells of `bitymi bench`, training curves, images, and folders with these."""
    output_dir: Path = Path("report")  # Folder of the page.
    title: str = "bitymi report"  # Heading of the page.

    def run(self) -> None:
        from .measure.report import page

        say(f"Wrote {page.build(self.inputs, self.output_dir, self.title)}")


@dataclass
class Stability:
    """Measure float32 errors on extreme scenes and write a page with a plot beside it."""

    output: Path = Path("stability.md")  # Markdown file; the plot is beside it, as .png.
    backend: Literal["cpu", "cuda", "emulated"] = "cpu"  # Kernels to measure.

    def run(self) -> None:
        from .measure.stability import page
        from .measure.stability.errors import BACKENDS, missing

        if why := missing(BACKENDS[self.backend]):
            raise ValueError(f"the backend '{self.backend}' cannot be used here: {why}")
        with write_errors_as(self.output, ValueError):
            rows = page.write(self.output, BACKENDS[self.backend], lambda text: say(text, sys.stderr))
        worse = [row.label for row in rows if "**" in row.verdict]
        say(f"Wrote {self.output}: {len(rows)} scenes, {len(worse)} of them beyond what float32 inputs allow")


def _suite(name: str, description: str) -> object:
    return tyro.conf.subcommand(name, default=BenchRun(data=tyro.MISSING, suite=name), description=description)


Which = (
    Annotated[BenchRun, _suite("local", "Your own captures: train, bake and evaluate a matrix of methods and seeds.")]
    | Annotated[BenchRun, _suite("mipnerf360", "Mip-NeRF 360: images_4 outdoors, images_2 indoors.")]
    | Annotated[BenchRun, _suite("tanksandtemples", "Tanks and Temples: train and truck.")]
    | Annotated[BenchRun, _suite("nerf-synthetic", "NeRF-Synthetic: eight objects on white.")]
)


@dataclass
class Bench:
    """Benchmarks: a matrix of scenes, methods and seeds."""

    what: Which

    def run(self) -> int:
        return self.what.run()


@dataclass
class Verify:
    """Check a bundle: files, hashes, formats, tiles; optionally also against the run it was baked from."""

    bundle: tyro.conf.Positional[Path]  # Folder of the bundle, or its one file (bitymi pack).
    run_config: Annotated[Path | None, tyro.conf.arg(name="run")] = None
    """config.yml, folder or checkpoint of the run: also compare the bundle's residuals and renders with the run's."""
    views: int | None = None  # Held-out views to render; not given: 4.

    def run(self) -> int:
        from rich.console import Console
        from rich.markup import escape
        from rich.table import Table

        from .bundle import REMEDY, check_files
        from .bundle.parts import NOTES

        if self.views is not None and self.run_config is None:
            raise ValueError("--views is for the comparison with a run: name that, too (--run)")
        bundle, checks = check_files(self.bundle)
        if bundle is not None and self.run_config is not None:
            from .plugin.export.trained import check_run

            checks += check_run(bundle, self.run_config, 4 if self.views is None else self.views)
        table = Table("", "check", "result", title=escape(printable(f"Bundle {self.bundle}")))
        for check in checks:
            outcome = "[green]ok[/]" if check.ok else "[bold red]FAILED[/]"
            table.add_row(
                outcome, escape(printable(check.name)), escape(printable(check.detail)) if check.ok else "see below"
            )
        Console().print(table)
        failed = [check for check in checks if not check.ok]
        for check in failed:
            say(f"{check.name}: {check.detail}")
        if any(check.name != NOTES for check in failed):  # notes.json is corrected or removed
            say(REMEDY)
        return 1 if failed else 0


def _say_left_out(names: Sequence[str]) -> None:
    """Report the files of a bundle that are not written."""
    if names:
        say(f"Left out, because no file of a bundle has such a name: {listed(names, most=5)}.", sys.stderr)


@dataclass
class Pack:
    """Write a bundle as one file, its parts in the order of their use; all commands read it like the folder."""

    bundle: tyro.conf.Positional[Path]  # Folder of the bundle, or its one file.
    output: Path | None = None  # File to write; not given: NAME.bitymi beside the folder.
    overwrite: Flag = False  # Replace an existing single-file bundle.

    def run(self) -> None:
        from .bundle.single import SUFFIX, is_single, write_single
        from .files import size_text

        bundle = Path(os.path.realpath(self.bundle))
        output = self.output or bundle.with_name(bundle.name + SUFFIX)
        if os.path.lexists(output) and not self.overwrite:
            raise ValueError(f"{output} is there already: choose another path (--output), or add --overwrite")
        if os.path.lexists(output) and not is_single(output):
            raise ValueError(f"{output} is no bundle and is not replaced: choose another path (--output)")
        with write_errors_as(output, ValueError):
            written = write_single(bundle, output)
        _say_left_out(written.left_out)
        say(f"Wrote {output}, {size_text(written.bytes)}; the surfels are in its first {size_text(written.first)}.")


@dataclass
class Unpack:
    """Write a single-file bundle as a folder, with a config.yml for nerfstudio's commands."""

    bundle: tyro.conf.Positional[Path]  # The one file, or a folder without config.yml.
    output: Path | None = None  # Folder to write; not given: beside the file, without .bitymi.

    def run(self) -> None:
        from .bundle.parts import CONFIG
        from .bundle.read import read_manifest
        from .bundle.single import SUFFIX, write_folder
        from .plugin.export.target import config_without_run

        folder = self.output or self.bundle.with_name(self.bundle.name.removesuffix(SUFFIX))
        config = config_without_run(folder, read_manifest(self.bundle))
        with write_errors_as(folder, ValueError):
            _say_left_out(write_folder(self.bundle, folder, {CONFIG: config}))
        say(f"Wrote {folder}: give {folder / CONFIG} to nerfstudio's commands.")


@dataclass
class Extras:
    """Convert a bundle for other programs, to a folder beside it: Gaussians, surfels, OpenUSD, or a textured mesh."""

    bundle: tyro.conf.Positional[Path]  # Folder of the bundle, or its one file.
    kinds: tuple[Literal["gaussians", "surfels", "usd", "mesh"], ...] = ("gaussians", "mesh")
    """gaussians: gaussians.ply, in 3DGS's format; surfels: surfels.ply, the same with two scales (2DGS, Brush); usd:
    surfels.usdc, OpenUSD's surflets; mesh: mesh.glb, a textured quad per surfel."""
    frame: Literal["scene", "capture"] = "scene"  # Frame of the files: the scene's, or the capture's.
    crop: Flag = False  # Leave out the surfels that notes.json hides.
    output: Path | None = None  # Folder to write; not given: NAME.extras beside the bundle.
    overwrite: Flag = False  # Replace an existing folder of extras.

    def run(self) -> None:
        from .bundle import read_bundle
        from .interchange import extras
        from .progress import rich_progress

        output = self.output or extras.extras_folder(self.bundle)
        bundle = read_bundle(self.bundle, crop=self.crop)
        cameras = extras.training_cameras(bundle)
        removed = extras.removal_line(self.kinds, output)
        with rich_progress() as progress:
            how = {"frame": self.frame, "cameras": cameras, "overwrite": self.overwrite, "progress": progress}
            written = extras.write_extras(bundle, output, self.kinds, **how)
        say(f"Wrote {output}" + (bundle.hidden and f"; {bundle.hidden}"))
        if removed:
            say(removed)
        for entry in written.values():
            say(extras.summary_line(entry))
        if not cameras:
            say("The bundle has no cameras.json: colours are those over the whole sphere, the mesh's as they are.")


@dataclass
class View:
    """Show a bundle in the browser, or export it with its page to a folder for any web server."""

    bundle: tyro.conf.Positional[Path]  # Folder of the bundle, or its one file.
    export: Path | None = None  # Folder to write page and bundle to; none = show it now.
    one_file: Flag = False  # With --export: the bundle as one file, read by range requests.
    overwrite: Flag = False  # Replace an exported page.
    host: str = "127.0.0.1"
    """Address to listen on. On one other than loopback, everyone who can reach this machine sees the bundle."""
    port: int = 0  # Port to listen on; 0 = any free port.
    open_browser: bool = True  # Open the page in the browser.

    def run(self) -> None:
        import webbrowser

        from . import view
        from .bundle.notes import hides
        from .files import size_text

        if self.one_file and self.export is None:
            raise ValueError("--one-file is for --export: say where to")
        site = view.single_site(self.bundle) if self.one_file else view.site_of(self.bundle)
        _say_left_out(site.left_out)
        if self.export is not None:
            with write_errors_as(self.export, ValueError):
                size = view.write_static(site, self.export, self.overwrite)
            say(f"Wrote {self.export}, {size_text(size)}: any web server can send it. Browsers ask for https then.")
            if hides(self.bundle):
                say("The page hides surfels as notes.json says. Its bundle still has all of them.")
            return
        server = view.serve(site, self.host, self.port)
        address = view.address_of(server)
        if not view.is_loopback(server):
            say(f"Everyone who can reach this machine sees {self.bundle} now.", sys.stderr)
        try:
            say(f"Showing {self.bundle} at {address} until Ctrl-C")
            if self.open_browser:
                webbrowser.open(address)
            server.serve_forever()
        except KeyboardInterrupt:
            pass
        finally:
            server.server_close()


@dataclass
class Doctor:
    """Describe this installation for a report of a problem, and try a training step on every device."""

    def run(self) -> int:
        from .measure.doctor import examine

        for name, line in examine():
            say(f"{name:11} {line or 'ns-train bitymi cannot train here'}")
        return 0 if line else 1


Command = Sample | Sfm | Report | Stability | Bench | Verify | Pack | Unpack | Extras | Doctor | View


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Errors that the user can correct print one line, no traceback."""
    command = tyro.cli(
        tyro.conf.OmitSubcommandPrefixes[Command],
        prog="bitymi",
        description="Textured Beta-surfel splatting for nerfstudio: helpers around ns-train, ns-export and ns-eval.",
        args=args,
    )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for terminals that lack a character
    try:
        return command.run() or 0
    except BrokenPipeError:
        raise
    except (ValueError, OSError, KernelsUnavailable) as error:
        say(f"bitymi: {exit_messages.line_of(error) or error}", sys.stderr)
        return 1
