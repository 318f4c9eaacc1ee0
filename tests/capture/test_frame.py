from pathlib import Path

import numpy as np
import pycolmap
import pytest

from bitymi_ns.capture.frame import UP, gps_line, local_positions, move_to_world, read_frame, write_frame


def synthetic(seed: int = 0) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 12, 50
    return pycolmap.synthesize_dataset(options)


def centers(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.projection_center() for image in model.images.values()}


def in_metres(model: pycolmap.Reconstruction) -> tuple[float, dict[str, np.ndarray]]:
    """Scale the cameras to a spread of 40 m."""
    scale = 40 / np.std(list(centers(model).values()))
    return scale, {name: scale * place for name, place in centers(model).items()}


def to_degrees(place: np.ndarray) -> tuple[float, float, float]:
    """Convert east, north and up in metres to degrees at 48 degrees north."""
    return 48.0 + place[1] / 111_199.5, 11.0 + place[0] / 74_628.4, 500.0 + place[2]


def test_a_degree_is_as_long_as_it_is() -> None:
    local, origin = local_positions({"a": (47.999, 11.0, 0.0), "b": (48.0, 11.0, 0.0), "c": (48.001, 11.001, 7.0)})
    assert origin == (48.0, 11.0, 0.0)
    assert local["c"] == pytest.approx([74.63, 111.20, 7.0], abs=0.02)


@pytest.mark.parametrize("middle", [179.9998, -179.9999])
def test_the_antimeridian_is_crossed(middle: float) -> None:
    longitudes = [(middle + step + 180) % 360 - 180 for step in (-0.0005, 0.0, 0.0005)]
    local, origin = local_positions({str(k): (48.0, longitudes[k], 0.0) for k in range(3)})
    assert origin[1] == pytest.approx(middle, abs=1e-9)
    assert [local[str(k)][0] for k in range(3)] == pytest.approx([-37.31, 0.0, 37.31], abs=0.02)


def test_gps_gives_metres_and_up() -> None:
    model = synthetic()
    turned = pycolmap.Sim3d(0.05, pycolmap.Rotation3d(np.array([0.3, -1.0, 0.5])), np.array([4.0, 5.0, 6.0]))
    _, true = in_metres(model)
    model.transform(turned)
    rng = np.random.default_rng(0)
    places = {name: to_degrees(place + rng.normal(0, 2, 3)) for name, place in true.items()}
    frame = move_to_world(model, places)
    assert frame.up == "gps" and frame.metres_per_unit == 1 and frame.gps_error < 5
    found = centers(model)
    names = list(true)
    spans = [(found[a] - found[b], true[a] - true[b]) for a in names for b in names if a < b]
    assert np.median([np.linalg.norm(a) / np.linalg.norm(b) for a, b in spans]) == pytest.approx(1, abs=0.05)


def test_the_larger_group_of_positions_counts(reported: list[str], tmp_path: Path) -> None:
    """The second half of the photographs is of another flight, 15 m higher."""
    model = synthetic()
    scale, true = in_metres(model)
    places = {name: to_degrees(place + (0, 0, 15 * (i >= 6))) for i, (name, place) in enumerate(true.items())}
    frame = move_to_world(model, places)
    assert frame.up == "gps" and frame.gps_error < 0.1
    turn = np.array(frame.transform)[:, :3]
    assert np.cbrt(np.linalg.det(turn)) == pytest.approx(scale, rel=0.002)
    assert turn[2] @ UP / np.linalg.norm(turn[2]) > 0.99999
    write_frame(tmp_path, frame)
    agree = "6 of 12 photographs with a position agree, with a median error of 0.0 m."
    assert gps_line(tmp_path) == f"GPS makes the world, in metres: {agree}"
    rng = np.random.default_rng(0)
    places = {name: to_degrees(place + rng.normal(0, 60, 3) * (i >= 5)) for i, (name, place) in enumerate(true.items())}
    assert move_to_world(synthetic(), places).up == "cameras"
    assert "GPS is not used" in reported[-1]


@pytest.mark.parametrize("size", [0.0, 3.0])
def test_positions_too_close_together_or_of_another_shape_say_nothing(size: float) -> None:
    model = synthetic()
    places = {name: to_degrees(size * np.random.default_rng(i).normal(size=3)) for i, name in enumerate(centers(model))}
    frame = move_to_world(model, places)
    assert frame.up == "cameras" and frame.metres_per_unit is None and frame.gps_positions == 12
    rng = np.random.default_rng(0)  # of another shape
    assert move_to_world(model, {name: to_degrees(rng.normal(0, 200, 3)) for name in places}).metres_per_unit is None


def test_without_gps_up_is_that_of_the_cameras(tmp_path: Path) -> None:
    model = synthetic()
    two = dict(list(held(model, np.array(UP)).items())[:2])  # accelerometers: too few
    frame = move_to_world(model, {}, two)
    write_frame(tmp_path, frame)
    assert read_frame(tmp_path) == frame
    ups = [-image.cam_from_world().rotation.matrix()[1] for image in model.images.values()]
    mean = np.mean(ups, axis=0)
    assert frame.up == "cameras" and mean @ [0, 0, 1] == pytest.approx(np.linalg.norm(mean), rel=1e-6)
    places = np.array(list(centers(model).values()))
    np.testing.assert_allclose(places.mean(axis=0), 0, atol=1e-9)
    assert np.linalg.norm(places, axis=1).mean() == pytest.approx(1)


def held(model: pycolmap.Reconstruction, up: np.ndarray, wrong: int = 0) -> dict[str, tuple[float, float, float]]:
    """Simulate accelerometers for this up vector with an error of a degree; the first `wrong` ones are wrong."""
    rng = np.random.default_rng(0)
    found = {}
    for i, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        said = rng.normal(size=3) if i < wrong else up + rng.normal(0, 0.017, 3)
        x, y, z = image.cam_from_world().rotation.matrix() @ (said / np.linalg.norm(said))
        found[image.name] = (x, y, z)
    return found


@pytest.mark.parametrize(("wrong", "source"), [(0, "gravity"), (4, "gravity"), (10, "cameras")])
def test_up_is_what_most_accelerometers_say(wrong: int, source: str) -> None:
    model = synthetic()
    up = np.array([0.36, 0.48, 0.8])
    frame = move_to_world(model, {}, held(model, up, wrong))
    assert frame.up == source and frame.metres_per_unit is None
    if source == "gravity":
        assert np.array(frame.transform)[2, :3] @ up / np.linalg.norm(np.array(frame.transform)[2, :3]) > 0.9998


def test_gravity_says_what_is_up_and_gps_how_long_a_metre_is() -> None:
    model = synthetic()
    scale, true = in_metres(model)
    ups = held(model, np.array(UP))
    rng = np.random.default_rng(0)
    places = {name: to_degrees(place + rng.normal(0, 4, 3)) for name, place in true.items()}
    frame = move_to_world(model, places, ups)
    assert frame.up == "gravity" and frame.metres_per_unit == 1 and frame.gps_error < 10
    turn = np.array(frame.transform)[:, :3]
    assert turn[2] @ UP / np.linalg.norm(turn[2]) > 0.9998
    assert np.cbrt(np.linalg.det(turn)) == pytest.approx(scale, rel=0.1)
    north = turn @ [0, 1, 0]
    assert north[1] / np.linalg.norm(north) > 0.97, "y is north"
