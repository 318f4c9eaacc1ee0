"""Views drawn in bands on the CUDA kernels."""

import pytest
import torch

from bitymi_ns import ops
from tests.cuda.conftest import only_short_lists
from tests.scene import bands

pytestmark = pytest.mark.slow


def test_values_and_gradients_do_not_change(device: torch.device) -> None:
    whole, want = bands.step(device, 0)
    parts, got = bands.step(device, len(whole) // 3)
    assert isinstance(parts, ops.Unlisted) and len(parts) == len(whole)
    bands.assert_same(got, want)


@pytest.mark.parametrize("fit", [1000, 500])
def test_lists_that_find_no_memory(device: torch.device, fit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bands of up to `fit` fragments can be drawn; a row of tiles with more raises an error that says so."""
    scene, camera = bands.make(device, 0)
    want = scene.render(camera)
    assert want.fragments.layout.handle.pairs < 500
    only_short_lists(monkeypatch, fit, 2 * fit)
    if fit == 500:
        with pytest.raises(ops.TooManyFragments, match=r"the view has [\d,]+ fragments.*, and there is room for 1,000"):
            scene.render(camera)
    else:
        torch.testing.assert_close(scene.render(camera).rgb, want.rgb, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("alpha", [False, True])
def test_bands_read_texels_that_no_other_band_has_moved(alpha: bool, device: torch.device) -> None:
    whole, want = bands.texel_step(device, 0, alpha)
    parts, got = bands.texel_step(device, len(whole) // 3, alpha)
    assert isinstance(parts, ops.Unlisted)
    bands.assert_same(got, want)
