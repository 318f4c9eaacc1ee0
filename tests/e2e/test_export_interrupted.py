"""Ctrl-C in an export leaves nothing half-written, and the message says what exists."""

from pathlib import Path
from typing import Any

import pytest

from bitymi_ns.bake import pipeline as bake_pipeline
from bitymi_ns.bake import tuning_views
from bitymi_ns.bundle import check_files
from bitymi_ns.plugin.export import command
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.e2e.exports import TOLERANCE, run_export
from tests.typed import Patch, Printed


def interrupted(*args: Any, **kwargs: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    "where, options, message",
    [
        ((tuning_views, "photometric"), {"tolerance": TOLERANCE}, "was not written"),
        ((bake_pipeline, "trained_texels"), {}, "was not written"),
        ((bake_pipeline, "trained_texels"), {"overwrite": True}, "is the earlier one"),
        ((command, "compare"), {"finetune_steps": 0}, "is complete"),
    ],
    ids=["fine-tuning", "bake", "bake of a replacement", "comparison"],
)
def test_ctrl_c_leaves_nothing_half_written_and_the_message_names_what_is_there(
    where: Any, options: Any, message: str, trained: Run, copied: Path, monkeypatch: Patch, capsys: Printed
) -> None:
    folder = copied if "overwrite" in options else copied.with_name("b")
    monkeypatch.setattr(*where, interrupted)
    with pytest.raises(SystemExit) as stop:
        run_export(trained, folder, **options)
    assert stop.value.code == 130 and message in " ".join(capsys.readouterr().out.split())
    if message == "was not written":
        assert list(copied.parent.iterdir()) == [copied]
    else:
        bundle = check_files(folder)[0]
        assert bundle is not None and (bundle.info.statistics.held_out is None) == (message == "is complete")


@pytest.mark.parametrize(
    ("call", "name", "state"),
    [
        ("mkdir", ".elsewhere.new", "is the earlier one"),  # the new one was started
        ("rename", "elsewhere", "is the earlier one"),  # the earlier one was moved away
        ("rename", ".elsewhere.new", "is complete"),  # the new one was moved into place
    ],
)
def test_ctrl_c_while_a_bundle_is_replaced_says_which_one_is_there(
    trained: Run, copied: Path, monkeypatch: Patch, capsys: Printed, call: str, name: str, state: str
) -> None:
    before = (copied / "bundle.json").read_bytes()
    do = getattr(Path, call)

    def interrupted_after(self: Path, *arguments: Any, **options: Any) -> Any:
        result = do(self, *arguments, **options)
        if self.name == name:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(Path, call, interrupted_after)
    with pytest.raises(SystemExit):
        run_export(trained, copied, overwrite=True, tolerance=2.0, compare=False, finetune_steps=0)
    monkeypatch.undo()
    assert state in " ".join(capsys.readouterr().out.split())
    assert ((copied / "bundle.json").read_bytes() == before) == (state == "is the earlier one")
    assert check_files(copied)[0] is not None and [p.name for p in copied.parent.iterdir()] == [copied.name]
