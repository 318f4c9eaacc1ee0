"""A bundle in one file, or without config.yml: read by our commands, refused in one line by nerfstudio's, and unpacked
to a folder that these open."""

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from nerfstudio.scripts import render
from PIL import Image

from bitymi_ns import cli
from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.bundle.manifest import dump
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.mesh import ExportMesh
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.plugin.hooks import find_config
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from bitymi_ns.trust import python_command
from tests.typed import Patch, Printed


@pytest.fixture(scope="module")
def packed(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "room.bitymi"
    assert cli.main(["pack", str(bundle), "--output", str(path)]) == 0
    return path


def test_an_unpacked_folder_is_opened(packed: Path, bundle: Path, tmp_path: Path, capsys: Printed) -> None:
    folder = tmp_path / "room"
    assert cli.main(["unpack", str(packed), "--output", str(folder)]) == 0
    assert "Wrote" in capsys.readouterr().out and all(check.ok for check in check_files(folder)[1])
    assert {path.name for path in folder.iterdir()} == {path.name for path in bundle.iterdir()}
    same = [path.name for path in bundle.iterdir() if path.name != "config.yml"]
    assert all((folder / name).read_bytes() == (bundle / name).read_bytes() for name in same)
    pictures = {}
    for name, config in (("bundle", bundle / "config.yml"), ("unpacked", folder / "config.yml")):
        options = dict(output_path=tmp_path / name, output_format="images", image_format="png", interpolation_steps=1)
        render.RenderInterpolated(load_config=config, pose_source="train", **options).main()
        pictures[name] = np.stack([np.array(Image.open(path)) for path in sorted((tmp_path / name).iterdir())])
    difference = pictures["bundle"].astype(int) - pictures["unpacked"]
    assert len(difference) > 3 and np.abs(difference).mean() < 0.1  # the capture's poses are rounded differently
    assert cli.main(["unpack", str(packed), "--output", str(folder)]) == 1
    assert "room is there already: choose another folder (--output)" in capsys.readouterr().err


@pytest.mark.slow
def test_a_file_gives_the_mesh_of_its_folder(packed: Path, bundle: Path, tmp_path: Path) -> None:
    found = []
    for config, name in ((packed, "a"), (bundle / "config.yml", "b"), (bundle, "c")):
        ExportMesh(load_config=config, output_dir=tmp_path / name, resolution=32).main()
        found.append(trimesh.load_mesh(tmp_path / name / "mesh.ply", process=False).vertices)
    assert all(np.array_equal(found[0], other) for other in found[1:])


def test_bundles_without_cameras_make_no_mesh(copied: Path, tmp_path: Path) -> None:
    info = read_bundle(copied).info
    del info.files["cameras.json"]
    (copied / "bundle.json").write_bytes(dump(info))
    with pytest.raises(InputError, match=r"has no cameras \(cameras.json\): give the config.yml of the run"):
        ExportMesh(load_config=copied / "config.yml", output_dir=tmp_path / "mesh").main()
    assert not (tmp_path / "mesh").exists()


@pytest.mark.parametrize("command", [["ns-eval"], ["ns-render", "spiral"], ["ns-export", "bitymi-atlas"]])
def test_commands_name_the_command(packed: Path, copied: Path, command: list[str], monkeypatch: Patch) -> None:
    monkeypatch.setattr(sys, "argv", [*command, "--load-config", str(copied / "config.yml")])
    find_config()
    text = (copied / "config.yml").read_text()
    (copied / "config.yml").write_text(text.replace("bitymi_ns.plugin.run.", "bitymi_ns.host."))
    with pytest.raises(InputError, match="config.yml is of an early version"):
        find_config()
    (copied / "config.yml").unlink()
    for given in (packed, packed / "config.yml", copied / "config.yml"):
        monkeypatch.setattr(sys, "argv", [*command, f"--load-config={given}"])
        with pytest.raises(InputError, match="has no config.yml for nerfstudio: .*`bitymi unpack "):
            find_config()
        monkeypatch.setattr(sys, "argv", ["ns-export", "bitymi-mesh", "--load-config", str(given)])
        find_config()
    with pytest.raises(InputError, match="is a bundle's"):
        load_trained(packed)


def test_commands_take_a_folder_and_name_what_is_missing(
    bundle: Path, trained: Run, tmp_path: Path, monkeypatch: Patch
) -> None:
    for folder in (bundle, trained.get_base_dir()):
        for given, found in (
            (["--load-config", str(folder)], str(folder / "config.yml")),
            ([f"--load-config={folder}"], f"--load-config={folder / 'config.yml'}"),
        ):
            monkeypatch.setattr(sys, "argv", ["ns-eval", *given])
            find_config()
            assert sys.argv[-1] == found
    for given in (tmp_path, tmp_path / "nowhere.yml"):
        monkeypatch.setattr(sys, "argv", ["ns-eval", "--load-config", str(given)])
        with pytest.raises(InputError, match="there is no .*yml: give the config.yml of a run"):
            find_config()
    monkeypatch.setattr(Path, "is_dir", denied)
    with pytest.raises(InputError, match="nowhere.yml cannot be read or written: you have no permission for it"):
        find_config()


def denied(path: Path) -> bool:
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


@pytest.mark.slow
def test_the_command_ends_in_one_line(packed: Path) -> None:
    command = [*python_command("nerfstudio.scripts.eval", "entrypoint"), "--load-config", packed]
    done = subprocess.run([*command, "--output-path", "unused.json"], capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if "Warning" not in line]
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert lines[-1].startswith("bitymi: ") and "`bitymi unpack" in lines[-1]


def test_no_bundle_is_explained(trained: Run, bundle: Path, tmp_path: Path, capsys: Printed) -> None:
    run, page = trained.get_base_dir(), tmp_path / "page"
    shutil.copytree(bundle, page / "bundle")
    checkpoint = next(trained.get_checkpoint_dir().glob("*.ckpt"))
    torch.save({}, tmp_path / "other.pt")
    (tmp_path / "letter.txt").write_text("dear")
    for command in ("view", "verify", "extras", "pack"):
        for given, said in (
            (run, f"has to be exported first: ns-export bitymi-atlas --load-config {run / 'config.yml'}"),
            (run / "config.yml", "has to be exported first"),
            (checkpoint, "has to be exported first"),
            (bundle / "config.yml", f"give {bundle}"),
            (page, f"give {page / 'bundle'}"),
            (tmp_path / "nowhere", "it does not exist"),
            (tmp_path / "other.pt", "it has no bundle.json"),
            (tmp_path / "letter.txt", "in one file: "),
        ):
            assert cli.main([command, str(given)]) == 1
            out, err = capsys.readouterr()
            assert f"{given} is not a bundle" in out + err and said in out + err
