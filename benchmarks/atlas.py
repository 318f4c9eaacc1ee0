#!/usr/bin/env python
"""What the atlas can leave out: size, error and speed of a trained run's bundles by rule.

For each run (config.yml of ns-train): ns-export by the paper's rule without a cap, with the cap by views, and with
every tolerance; ns-eval of the run and of all bundles. Finished cells are kept in --work and not done again. dPSNR is
against that of the trained scene on the photographs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from common import Bench, CommandFailed, add_output_options, difference, number, page, publish, run_measured, say, table
from common import tool as find_tool

RULES = {
    "paper's rule (--exact)": ["--exact", "True"],
    "view cap": ["--tolerance", "0", "--drop-unseen", "False"],
}
HEADER = (
    "run",
    "rule",
    "surfels",
    "tiles",
    "texels a surfel",
    "atlas bytes",
    "of the rule",
    "dPSNR",
    "PSNR to neural",
    "dFLIP",
    "render ms",
    "error p99",
)
NOTES = (
    "Atlas bytes: the KTX2 file. PSNR to neural: mean over the held-out views of bundle against trained scene.",
    "Error p99: weighted root mean square of a tile against the field as stored, 8-bit steps, 99th percentile.",
)


def export(bench: Bench, config: Path, format: str, rule: str, arguments: list[str]) -> dict[str, Any]:
    """Bake a run by a rule; what the bundle states about itself."""

    def make() -> dict[str, Any]:
        folder = _bundle(bench, config, format, rule)
        shutil.rmtree(folder, ignore_errors=True)
        command = [find_tool("ns-export"), "bitymi-atlas", "--load-config", str(config), "--output-dir", str(folder)]
        cost = run_measured([*command, "--format", format, *arguments], folder.with_suffix(".log"))
        info = json.loads((folder / "bundle.json").read_text("utf8"))
        return {"process_seconds": cost.seconds, "cpu_seconds": cost.cpu_seconds, "statistics": info["statistics"]}

    return bench.cells.get({"cell": "atlas export", "run": str(config), "format": format, "rule": rule}, make)


def evaluate(bench: Bench, config: Path, name: str) -> dict[str, Any]:
    """ns-eval of a run or bundle: nerfstudio's `results`."""

    def make() -> dict[str, Any]:
        result = bench.work / "evals" / "atlas" / f"{name}.json"
        result.parent.mkdir(parents=True, exist_ok=True)
        command = [find_tool("ns-eval"), "--load-config", str(config), "--output-path", str(result)]
        run_measured(command, result.with_suffix(".log"))
        return json.loads(result.read_text("utf8"))["results"]

    return bench.cells.get({"cell": "atlas eval", "config": str(config)}, make)


def _bundle(bench: Bench, config: Path, format: str, rule: str) -> Path:
    name = "".join(c if c.isalnum() or c == "." else "-" for c in rule)
    return bench.work / "bundles" / "atlas" / config.parents[2].name / config.parent.name / f"{format}-{name}"


def measure(bench: Bench, config: Path, format: str, rules: dict[str, list[str]]) -> tuple[list[list[str]], list[str]]:
    """The lines of one run, and the commits that made them."""
    scene = config.parents[2].name
    neural = evaluate(bench, config, f"{scene}-{config.parent.name}-neural")
    made, rows, first = [neural["commit"]], [], None
    for rule, arguments in rules.items():
        baked = export(bench, config, format, rule, arguments)
        folder = _bundle(bench, config, format, rule)
        results = evaluate(bench, folder / "config.yml", f"{scene}-{config.parent.name}-{folder.name}")
        made += [baked["commit"], results["commit"]]
        statistics = baked["statistics"]
        size, kept = results["atlas_bytes"], statistics["surfels"]["kept"]
        first = first or size
        rows.append(
            [
                scene,
                rule,
                number(kept, 0),
                number(kept - statistics["surfels"].get("without_tile", kept), 0),
                number(statistics.get("texels", {}).get("kept", 0) / kept, 0),
                number(size, 0),
                f"{size / first:.3f}",
                difference(results["psnr"] - neural["psnr"]),
                number(statistics.get("held_out", {}).get("psnr_baked_against_neural")),
                difference(results["flip"] - neural["flip"], 4) if "flip" in neural else "",
                number(results["render_ms"], 1),
                number(statistics.get("error", {}).get("rms", {}).get("p99"), 2),
            ]
        )
    return rows, made


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--runs", nargs="+", type=Path, required=True, help="config.yml of trained runs")
    parser.add_argument("--tolerances", nargs="+", default=["0.5", "1", "2"], help="8-bit steps (%(default)s)")
    parser.add_argument("--format", default="bc7", help="atlas format (%(default)s)")
    add_output_options(parser)
    options = parser.parse_args()
    rules = RULES | {f"error bound {t}": ["--tolerance", t] for t in options.tolerances}
    bench, rows, commits, failed = Bench(options.work), [], [], []
    for config in options.runs:
        try:
            lines, made = measure(bench, config.expanduser().resolve(), options.format, rules)
        except CommandFailed as error:
            say(str(error))
            failed.append(f"{config}: failed, see the messages above.")
            continue
        rows += lines
        commits += made
    publish(page("Atlas: what can be left out", table(HEADER, rows, 2), [*NOTES, *failed], commits), options.output)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
