"""Files that other programs leave in a capture."""

from pathlib import Path

from bitymi_ns.capture.pictures import pictures_among, poses_in


def test_poses_of_other_programs(tmp_path: Path) -> None:
    (tmp_path / "Cameras.xml").write_text('<document><chunk><cameras><camera id="0"/></cameras></chunk></document>')
    (tmp_path / "config.xml").write_text("<settings/>")
    (tmp_path / "poses_bounds.npy").touch()
    (tmp_path / "cameras.npz").mkdir()
    found = {path.name: program for path, program in poses_in(tmp_path)}
    assert found == {"Cameras.xml": "Metashape", "poses_bounds.npy": "LLFF"}


def test_raw_data_beside_photographs_do_not_count() -> None:
    names = ["a.DNG", "b.dng", "c.nef", "d.jxl", "a.jpg", "notes.txt"]
    assert pictures_among(names, ["a.jpg"]) == {".dng": 1, ".nef": 1, ".jxl": 1}
    assert pictures_among(["a.jpg"], ["a.jpg"]) == {}
