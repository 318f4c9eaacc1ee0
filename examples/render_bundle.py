"""Render a bundle to pictures, from the cameras that it was exported with.

python examples/render_bundle.py --bundle demo/bundle --output pictures
"""

import json
from pathlib import Path

import torch
import tyro
from PIL import Image

import bitymi_ns


def main(bundle: Path, output: Path, most: int = 8, device: str = "cpu") -> list[Path]:
    """Draw up to `most` of the cameras in the bundle's cameras.json as PNG files; returns their paths."""
    scene = bitymi_ns.read_bundle(bundle).to(device)
    output.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, view in enumerate(json.loads((bundle / "cameras.json").read_text("utf8"))["cameras"][:most]):
        fx, fy, cx, cy = (view[name] for name in ("fx", "fy", "cx", "cy"))
        K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        viewmat = torch.tensor(view["viewmat"]).view(4, 4)  # world to camera, OpenCV axes
        camera = bitymi_ns.Camera(viewmat, K, view["width"], view["height"])
        rgb = scene.render(camera.to(device)).rgb  # [H, W, 3]
        paths.append(output / f"{i:03}.png")
        Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()).save(paths[-1])
    print(f"{len(paths)} pictures in {output}")
    return paths


if __name__ == "__main__":
    tyro.cli(main)
