"""Selection of held-out photographs."""

from pathlib import Path

from bitymi_ns.capture import splits
from bitymi_ns.capture.find_files import find_named
from tests.captures import refused

NAMES = [Path(f"/c/images/{n:02}.jpg") for n in range(20)]
TWINS = [Path("/c/left/a.jpg"), Path("/c/left/b c.jpg"), Path("/c/right/a.jpg"), Path("/c/right/\u00e4.jpg")]


def test_every_eighth_by_name() -> None:
    split = splits.by_mode(NAMES, "interval", 8, 0.9)
    assert split.held_out == [0, 8, 16] and sorted(split.train + split.held_out) == list(range(20))
    assert "3 of 20 photographs, every 8th by name (00.jpg, 08.jpg and 1 more)." in split.describe(NAMES)


def test_the_other_rules() -> None:
    assert splits.by_mode(NAMES, "all", 8, 0.9).held_out == list(range(20))
    assert len(splits.by_mode(NAMES, "fraction", 8, 0.9).train) == 18
    named = [Path("eval_1.jpg"), Path("train_1.jpg"), Path("train_2.jpg")]
    assert splits.by_mode(named, "filename", 8, 0.9)[:2] == ([1, 2], [0])
    with refused("--eval-mode filename: .*Use `--eval-names`"):
        splits.by_mode(NAMES, "filename", 8, 0.9)


def test_names_with_as_many_folders_as_they_need() -> None:
    assert splits.by_names(TWINS, ["right/a.jpg", "b c.jpg", "\u00e4.jpg"], "--eval-names").held_out == [1, 2, 3]
    assert splits.by_names(TWINS, ["/c/left/a.jpg"], "--eval-names").train == [1, 2, 3]
    with refused("a.jpg is the name of 2 photographs, /c/left/a.jpg, /c/right/a.jpg. Give its folder, too"):
        splits.by_names(TWINS, ["a.jpg"], "--eval-names")
    with refused("--eval-names: 2 of 3 names are of no photograph of the capture: x.jpg, right/b c.jpg"):
        splits.by_names(TWINS, ["x.jpg", "left/a.jpg", "right/b c.jpg"], "--eval-names")
    with refused("1 of 1 names"):
        splits.by_names(TWINS, [""], "--eval-names")


def test_names_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "held out.txt"
    path.write_text("# these\n00.jpg\n\n 08.jpg \n", "utf8")
    assert splits.read_names([str(path)]) == ("00.jpg", "08.jpg")
    assert splits.read_names(["a.jpg", "b.txt"]) == ("a.jpg", "b.txt")
    path.write_text("# none\n")
    with refused("lists no names"):
        splits.read_names([str(path)])
    with refused("gone.txt cannot be read"):
        splits.read_names([str(tmp_path / "gone.txt")])


def test_names_in_another_case_or_with_another_ending() -> None:
    assert find_named(TWINS, ["RIGHT/A.JPG", "b c.png", "a\u0308", "Left\\a"], "the lists") == [2, 1, 3, 0]
    with refused("a.png is the name of 2 photographs"):
        find_named(TWINS, ["a.png"], "the lists")


def test_names_of_another_machine() -> None:
    names = ["D:\\scan\\left\\a.jpg", "/home/me/scan/right/a.jpg", "b c.jpg"]
    assert find_named(TWINS, names, "the lists", any_folder=True) == [0, 2, 1]
    with refused("2 of 3 names are of no photograph"):  # user-given names match exactly
        find_named(TWINS, names, "--eval-names")
