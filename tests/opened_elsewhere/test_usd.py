"""Surflets as OpenUSD reads them back, and as its validators judge them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import Bundle, BundleError
from bitymi_ns.interchange import extras
from bitymi_ns.interchange.extras import write_extras
from bitymi_ns.interchange.gaussians import HARD_BETA
from bitymi_ns.interchange.usd import write_usd
from bitymi_ns.ops.constants import BETA_MAX
from tests.opened_elsewhere.splat import gaussians

pxr = pytest.importorskip("pxr")
KERNELS = ("gaussian_surflets", "constant_surflets")


def complaints(path: Path) -> list[str]:
    from pxr import Usd, UsdValidation

    stage = Usd.Stage.Open(str(path))
    metadata = UsdValidation.ValidationRegistry().GetAllValidatorMetadata()
    names = [each.name for each in metadata if not each.isSuite and "Package" not in each.name]
    validators = UsdValidation.ValidationRegistry().GetOrLoadValidatorsByName(names)
    assert len(validators) > 20
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    return [error.GetErrorAsString() for error in found]


def test_usd_reads_back_what_was_written(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdVol

    written, place = gaussians(10), np.eye(4)
    place[:3] = [[0, 1, 0, 5], [0, 0, 1, 6], [1, 0, 0, 7]]
    write_usd(tmp_path / "a.usdc", written, place)
    assert complaints(tmp_path / "a.usdc") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetDefaultPrim().GetName() == "scene"
    for name, rows in zip(KERNELS, (~written.hard, written.hard), strict=True):
        prim = stage.GetPrimAtPath(f"/scene/{name}")
        kernel = f"ParticleFieldKernel{'Gaussian' if name == KERNELS[0] else 'Constant'}SurfletAPI"
        assert prim.GetTypeName() == "ParticleField" and kernel in prim.GetAppliedSchemas()
        part = written[rows]
        positions = np.array(UsdVol.ParticleFieldPositionAttributeAPI(prim).GetPositionsAttr().Get())
        assert np.array_equal(positions, part.means.numpy())
        moved = UsdGeom.XformCache().GetLocalToWorldTransform(prim).Transform(tuple(positions[0].tolist()))
        assert np.allclose(moved, place[:3, :3] @ positions[0] + place[:3, 3], atol=1e-6)
        quats = [
            [q.GetReal(), *q.GetImaginary()]
            for q in UsdVol.ParticleFieldOrientationAttributeAPI(prim).GetOrientationsAttr().Get()
        ]
        assert np.allclose(quats, part.quats)
        scales = np.array(UsdVol.ParticleFieldScaleAttributeAPI(prim).GetScalesAttr().Get())
        assert np.allclose(scales[:, :2], (2.0 if name == KERNELS[1] else 1.0) * part.log_scales[:, :2].exp())
        opacities = np.array(UsdVol.ParticleFieldOpacityAttributeAPI(prim).GetOpacitiesAttr().Get())
        assert np.allclose(opacities, part.opacity_logits.sigmoid())
        radiance = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(prim)
        coefficients = radiance.GetRadianceSphericalHarmonicsCoefficientsAttr()
        assert np.array_equal(np.array(coefficients.Get()).reshape(-1, 16, 3), part.harmonics.numpy())
        assert coefficients.GetColorSpace() == "srgb_rec709_scene"
        low, high = np.array(UsdVol.ParticleField(prim).GetExtentAttr().Get())
        assert (positions >= low).all() and (positions <= high).all()


@pytest.mark.parametrize("frame", ["scene", "capture"])
def test_extras_of_a_bundle_are_valid_usd(bundle: Bundle, frame: str, tmp_path: Path) -> None:
    from pxr import Usd

    written = write_extras(bundle, tmp_path / "out", ["usd"], frame=frame)
    assert written["usd"].count == 12 and complaints(tmp_path / "out" / "surfels.usdc") == []
    stage = Usd.Stage.Open(str(tmp_path / "out" / "surfels.usdc"))
    counts = [len(prim.GetAttribute("opacities").Get()) for prim in stage.GetDefaultPrim().GetChildren()]
    assert sum(counts) == 12


def test_the_kernel_is_the_nearer_one() -> None:
    x = (torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000  # r^2 / R^2
    for beta in (0.01, HARD_BETA - 0.01, HARD_BETA + 0.01, BETA_MAX):
        kernel = (1 - x) ** beta
        gaussian, disc = torch.exp(-x * (beta + 2)), (x < 2 / (beta + 2)).double()
        nearer = (kernel - disc).square().mean() < (kernel - gaussian).square().mean()
        assert bool(nearer) == (beta < HARD_BETA)


def test_usd_without_openusd_says_what_to_install(bundle: Bundle, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(BundleError, match="pip install"):
        extras.check_extras(["usd"], tmp_path / "out", False)
