"""Flat Gaussians and discs as OpenUSD surflets (ParticleField, OpenUSD 26.03 and later)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from bitymi_ns.bundle.manifest import BundleError
from .gaussians import Gaussians


def check_usd() -> None:
    """Raise BundleError if OpenUSD cannot be imported or is too old for surflets."""
    try:
        from pxr import UsdVol

        UsdVol.ParticleFieldKernelConstantSurfletAPI  # noqa: B018
    except (ImportError, AttributeError) as error:
        raise BundleError('the kind usd needs OpenUSD 26.03 or later: pip install "usd-core>=26.3"') from error


def write_usd(path: str | Path, gaussians: Gaussians, place: np.ndarray) -> None:
    """Write a binary USD file, .usdc, with a ParticleField prim per kernel.

    A surflet is a disc in its xy plane with kernel exp(-r^2 / 2) (GaussianSurfletAPI), or 1 up to r = 1
    (ConstantSurfletAPI). Spherical harmonics have degree 3, the basis and offset of 3DGS, and give sRGB colors. Third
    scales are omitted, discs (`Gaussians.hard`) get twice the scales. `place`: transform [4, 4] of the root to a frame
    with +y up; its unit is taken as a metre."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/scene")
    root.AddTransformOp().Set(Gf.Matrix4d(place.T.tolist()))  # USD multiplies row vectors
    stage.SetDefaultPrim(root.GetPrim())
    kernels = {
        "gaussian_surflets": (UsdVol.ParticleFieldKernelGaussianSurfletAPI, ~gaussians.hard, 1.0, 3.0),
        "constant_surflets": (UsdVol.ParticleFieldKernelConstantSurfletAPI, gaussians.hard, 2.0, 1.0),
    }
    for name, (kernel, chosen, radius, support) in kernels.items():
        if not bool(chosen.any()):
            continue
        part = gaussians[chosen]
        field = UsdVol.ParticleField.Define(stage, f"/scene/{name}")
        prim = field.GetPrim()
        kernel.Apply(prim)
        scales = radius * part.log_scales.exp()
        scales[:, 2] = 1.0  # the kernel has no depth
        reach = scales[:, :2].amax(1, keepdim=True) * support
        quats = Vt.QuatfArray([Gf.Quatf(*quat) for quat in part.quats.tolist()])
        opacities = _vectors(Vt.FloatArray, part.opacity_logits.sigmoid())
        UsdVol.ParticleFieldPositionAttributeAPI.Apply(prim).CreatePositionsAttr(_vectors(Vt.Vec3fArray, part.means))
        UsdVol.ParticleFieldOrientationAttributeAPI.Apply(prim).CreateOrientationsAttr(quats)
        UsdVol.ParticleFieldScaleAttributeAPI.Apply(prim).CreateScalesAttr(_vectors(Vt.Vec3fArray, scales))
        UsdVol.ParticleFieldOpacityAttributeAPI.Apply(prim).CreateOpacitiesAttr(opacities)
        radiance = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI.Apply(prim)
        radiance.CreateRadianceSphericalHarmonicsDegreeAttr(3)
        coefficients = _vectors(Vt.Vec3fArray, part.harmonics.reshape(-1, 3))
        radiance.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients).SetColorSpace(
            Gf.ColorSpaceNames.SRGBRec709
        )
        corners = (part.means - reach).amin(0), (part.means + reach).amax(0)
        prim.CreateAttribute("extent", Sdf.ValueTypeNames.Float3Array, custom=False).Set(
            Vt.Vec3fArray([Gf.Vec3f(*corner.tolist()) for corner in corners])
        )
    stage.Save()


def _vectors(kind: Any, values: Tensor) -> object:
    return kind.FromNumpy(np.ascontiguousarray(values.numpy()))
