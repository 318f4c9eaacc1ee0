"""The `bitymi` console script: tyro subcommands, each a thin call into the package (training, baking and evaluation
are nerfstudio's own commands: ns-train, ns-export, ns-eval)."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

# A switch without its --no- twin, where this tyro knows how.
Flag = tyro.conf.FlagCreatePairsOff[bool] if hasattr(tyro.conf, "FlagCreatePairsOff") else bool


@dataclass
class Sample:
    """Ray-trace a small room and write it as a nerfstudio capture: images, exact cameras and sparse points."""

    output_dir: Path
    """Folder to write; it must not hold anything yet."""
    views: int = 60
    """Number of images."""
    width: int = 320
    """Image width in pixels."""
    height: int = 240
    """Image height in pixels."""
    seed: int = 0
    """Chooses textures, camera path and points; equal seeds give equal captures."""
    points: int = 8000
    """Number of sparse points."""
    overwrite: Flag = False
    """Replace the folder if it holds something."""

    def run(self) -> None:
        from bitymi_ns import sample

        folder = sample.generate(
            self.output_dir,
            views=self.views,
            width=self.width,
            height=self.height,
            seed=self.seed,
            points=self.points,
            overwrite=self.overwrite,
            progress=True,
        )
        print(f"Wrote {self.views} images and {self.points} points to {folder}")


@dataclass
class Report:
    """Turn ns-eval results and training logs into one page: tables and plots of error against time."""

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """JSON files that ns-eval wrote, training curves, images, and folders to search for these."""
    output_dir: Path = Path("report")
    """Folder to write the page to."""
    title: str = "bitymi report"
    """Heading of the page."""

    def run(self) -> None:
        from bitymi_ns import report

        if not self.inputs:
            raise ValueError("nothing to report: name at least one JSON file that ns-eval wrote")
        try:
            page = report.build(list(self.inputs), self.output_dir, title=self.title)
        except report.ReportError as error:
            raise ValueError(str(error)) from error
        print(f"Wrote {page}")


@dataclass
class Stability:
    """Measure what float32 costs on extreme scenes and write the page of it, with a plot beside it."""

    output: Path = Path("docs/stability.md")
    """Markdown file to write; the plot gets its name with .png."""
    backend: str = "cpu"
    """Kernels to measure."""

    def run(self) -> None:
        from bitymi_ns.stability import page
        from bitymi_ns.stability.backends import BACKENDS

        if self.backend not in BACKENDS:
            raise ValueError(f"there is no backend '{self.backend}': choose one of {', '.join(BACKENDS)}")
        rows = page.write(self.output, BACKENDS[self.backend], lambda text: print(text, file=sys.stderr))
        worse = [row.label for row in rows if "**" in row.verdict]
        print(f"Wrote {self.output}: {len(rows)} scenes, {len(worse)} of them beyond what float32 inputs allow")


Command = (
    Annotated[Sample, tyro.conf.subcommand(name="sample")]
    | Annotated[Report, tyro.conf.subcommand(name="report")]
    | Annotated[Stability, tyro.conf.subcommand(name="stability")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status. What the user can put right is one line on stderr, not a traceback."""
    command = tyro.cli(
        tyro.conf.OmitSubcommandPrefixes[Command],
        prog="bitymi",
        description="Textured Beta-surfel splatting for nerfstudio: helpers around ns-train, ns-export and ns-eval.",
        args=args,
    )
    try:
        command.run()
    except (ValueError, OSError) as error:
        # a full disk does not say where it is full
        where = "" if not isinstance(error, OSError) or error.filename else f" ({command.output_dir})"
        print(f"bitymi: {error}{where}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("bitymi: interrupted, nothing was left half-written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
