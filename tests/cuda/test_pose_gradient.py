"""Gradients of the camera's pose on CUDA, against the CPU."""

import pytest
import torch

from tests.ops.golden import GOLDEN_NAMES, load_golden, relative
from tests.ops.test_pose_gradient import gradient, loss_of

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", [name for name in GOLDEN_NAMES if name != "textured"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_equal_to_the_cpu(name: str, dtype: torch.dtype, device: torch.device, cpu) -> None:
    case = load_golden(name)
    got = gradient(loss_of(case, dtype, device))
    with cpu():
        want = gradient(loss_of(case, torch.float64))
    hard = name in ("edge_on", "hard_discs", "offcentre_fx_fy")  # rims amplify float32 rounding
    assert relative(got, want) < (1e-9 if dtype == torch.float64 else 0.1 if hard else 1e-2)
