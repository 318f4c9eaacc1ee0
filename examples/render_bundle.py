"""Render a bundle to pictures, from the cameras that it was exported with.

python examples/render_bundle.py --bundle demo/bundle --output pictures
"""

from pathlib import Path

import tyro
from PIL import Image

import bitymi_ns


def main(bundle: Path, output: Path, most: int = 8, device: str = "cpu") -> list[Path]:
    """Render the views of the bundle's first `most` cameras to PNG files; return their paths."""
    scene = bitymi_ns.read_bundle(bundle).to(device)
    output.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, view in enumerate(scene.cameras[:most]):
        rgb = scene.render(view.camera.to(device)).rgb  # [H, W, 3]
        paths.append(output / f"{i:03}.png")
        Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()).save(paths[-1])
    print(f"{len(paths)} pictures in {output}")
    return paths


if __name__ == "__main__":
    tyro.cli(main)
