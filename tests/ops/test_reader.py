"""Kernels take keyword arguments, and name a wrong one."""

import pytest
import torch

from bitymi_ns.ops.backend import Pool, module

kernels = module(torch.device("cpu"))


def arguments(**changed: object) -> dict[str, object]:
    a, b, value = torch.zeros(12, 12, 1), torch.zeros(12, 12, 1), torch.zeros(())
    return {"a": a, "b": b, "height": 12, "width": 12, "channels": 1, "value": value, "da": None} | changed


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        (
            {"a": torch.zeros(12, 12, 1).double()},
            TypeError,
            "a must be a dense float32 array on the CPU, not .*float64",
        ),
        ({"a": torch.zeros(12, 24, 1)[:, ::2]}, TypeError, "ssim_f32: a must be a dense float32 array"),
        ({"b": torch.zeros(12, 12, 1, device="meta")}, TypeError, "b must be .* on the CPU, not .* meta"),
        ({"b": torch.zeros(12, 11, 1)}, ValueError, "b has 132 elements, expected 144"),
        ({"da": torch.zeros(1)}, ValueError, "da has 1 elements, expected 144"),
        ({"b": None}, TypeError, "b must be a dense float32 array on the CPU, not .*None"),
        ({"width": "12"}, TypeError, "width must be a number, not .*str"),
        ({"depth": 1}, TypeError, "ssim_f32 takes no argument 'depth'"),
    ],
)
def test_a_wrong_argument_is_named(changed: dict[str, object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        kernels.ssim_f32(**arguments(**changed))
    given = arguments()
    kernels.ssim_f32(**given)
    assert float(given.pop("value")) == 1.0
    with pytest.raises(TypeError, match="ssim_f32 lacks the argument 'value'"):
        kernels.ssim_f32(**given)


def test_methods_and_classes_name_themselves() -> None:
    with pytest.raises(TypeError, match=r"^Trace.run lacks the argument 'radii'"):
        kernels.Trace_f32().run()
    with pytest.raises(TypeError, match=r"^Patches: layers must be a number"):
        kernels.Patches(layers="none")


def test_arrays_are_tensors_parameters_or_of_numpy() -> None:
    a = torch.rand(12, 12, 1)
    found = []
    for kind in (a, torch.nn.Parameter(a), a.clone().requires_grad_(), a.numpy(), a.expand(1, 12, 12, 1)):
        given = arguments(a=kind)
        kernels.ssim_f32(**given)
        found.append(float(given["value"]))
    assert len(set(found)) == 1 and 0.0 < found[0] < 1.0
    memory = torch.zeros(4 * 144 + 1, dtype=torch.uint8).numpy()  # misaligned, which numpy permits
    with pytest.raises((TypeError, ValueError), match="ssim_f32: a must"):
        kernels.ssim_f32(**arguments(a=memory[1:].view("f4")))


def test_names_that_are_known_and_objects_of_the_module() -> None:
    n = 3
    to = {"means": torch.zeros(n, 3), "center": torch.zeros(3).double(), "active": torch.ones(n, dtype=torch.uint8)}
    colors = {"terms": 1, "a": torch.zeros(n, 3), "b": torch.zeros(n, 0), "out": torch.zeros(n, 3)}
    kernels.view_color_forward_f32(kind="sh", **to, **colors)
    with pytest.raises(ValueError, match="kind cannot be 'fancy'"):
        kernels.view_color_forward_f32(kind="fancy", **to, **colors)
    with pytest.raises(TypeError, match="field must be an object of this module, not .*str"):
        kernels.field_forward_f32(field="none", x=torch.zeros(1, 3), rho=torch.zeros(1, 3))
    reduced = {
        "span": torch.tensor([[0, 2]] * n, dtype=torch.int32),
        "reduced": torch.zeros(1, 6),
        "out": torch.zeros(n, 3),
    }
    with pytest.raises(ValueError, match="the terms of surfel 0's view colour are not there"):
        kernels.view_color_forward_f32(kind="sv", **to, base=torch.zeros(n, 3), **reduced)


def test_a_pool_gives_what_is_idle_and_forgets_what_failed() -> None:
    pool = Pool(object)
    with pool.borrow() as first, pool.borrow() as second:
        assert first is not second
    with pool.borrow() as again:
        assert again in (first, second)
    with pytest.raises(ZeroDivisionError), pool.borrow() as failed:
        1 / 0  # noqa: B018
    with pool.borrow() as one, pool.borrow() as other:
        assert failed not in (one, other)
